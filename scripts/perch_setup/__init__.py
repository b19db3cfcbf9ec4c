"""Set-up of perch on a bare machine, and entry into its environment.

Only the standard library is used here, because nothing else is installed when this code first runs.
"""

from .enter import command_parser, enter, exec_program, leave_quietly_on_interrupt, quiet_on_interrupt, run, setting_up
from .layout import EXTRAS, ROOT
from .prepare import prepare

__all__ = ["EXTRAS", "ROOT", "command_parser", "enter", "exec_program", "leave_quietly_on_interrupt", "prepare", "quiet_on_interrupt", "run",
           "setting_up"]
