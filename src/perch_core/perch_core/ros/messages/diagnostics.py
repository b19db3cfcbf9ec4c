"""Conversions of a component's diagnostics to and from `diagnostic_msgs/DiagnosticArray`."""

from __future__ import annotations

from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from perch_core.component import Diagnostics
from perch_core.ros.messages.basic import stamp_value, to_stamp


def diagnostics_message(diagnostics: Diagnostics, name: str = "") -> DiagnosticArray:
    """Convert diagnostics to an array of one status; floats have six digits. `name`: fully qualified name of the node."""
    status = DiagnosticStatus(level=bytes([diagnostics.level]), name=name, message=diagnostics.message, hardware_id="perch")
    status.values = [KeyValue(key=key, value=f"{v:.6g}" if isinstance(v, float) else str(v)) for key, v in diagnostics.values.items()]
    array = DiagnosticArray(status=[status])
    array.header.stamp = to_stamp(diagnostics.stamp)
    return array


def diagnostics_value(msg: DiagnosticArray) -> Diagnostics:
    """Convert the first status of an array; `values` also has the node's name as `node`."""
    status = msg.status[0] if msg.status else DiagnosticStatus()
    values: dict[str, Any] = {"node": status.name} | {pair.key: pair.value for pair in status.values}
    level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
    return Diagnostics(stamp_value(msg.header.stamp), values, level, status.message)
