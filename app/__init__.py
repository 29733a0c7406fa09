"""The command, the loop, the viewer and the reports."""
