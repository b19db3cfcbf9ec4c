"""Messages to values and back: `<thing>_message(value)` and `<thing>_value(message)`.

They convert and nothing else: whether a value makes sense is checked by the component that takes it. Floats are converted
explicitly, as rclpy does not check field types by default.
"""
