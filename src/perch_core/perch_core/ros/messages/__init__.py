"""Conversions of messages to values and back: `<thing>_message(value)` and `<thing>_value(message)`.

They only convert; the component that receives a value checks whether it is plausible. Floats are converted
explicitly, as rclpy does not check field types by default.
"""
