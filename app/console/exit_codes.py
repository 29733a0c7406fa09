"""How a command ends: its exit codes, the same for all."""

OK = 0
FAILED = 1
"""Something that was asked for could not be done."""
MISUSED = 2
"""The command line or a settings file asks for what there is not."""
INTERRUPTED = 130
"""Ctrl-C, or the system's request to end; 128 + SIGINT, as shells count it."""
