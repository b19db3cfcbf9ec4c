"""Several nodes in one process, on one executor.

    composed PLAN.json

The plan is a list of `{"name": ..., "module": ..., "arguments": [ROS arguments]}`; `start_stack.py --composed` writes it.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

from perch_core.interrupts import quiet_on_interrupt

with quiet_on_interrupt():
    from perch_core.ros.node import run


def main() -> None:
    """Run the nodes of a plan until SIGINT or SIGTERM; exit code 2 if the plan or the parameters of a node are refused."""
    if len(sys.argv) != 2 or sys.argv[1].startswith("-"):
        print("usage: composed PLAN.json (start_stack.py --composed writes one)", file=sys.stderr)
        sys.exit(2)
    try:
        plan = json.loads(Path(sys.argv[1]).read_text())
    except (OSError, ValueError) as error:
        print(f"error: {sys.argv[1]}: {error}", file=sys.stderr)
        sys.exit(2)
    run(lambda wiring: [importlib.import_module(entry["module"]).create(wiring, cli_args=entry["arguments"], use_global_arguments=False)
                        for entry in plan], [])


if __name__ == "__main__":
    main()
