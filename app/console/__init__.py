"""The terminal: errors, output, progress, interruption, and how commands are declared.

Every module here is public to `app`. Nothing is imported ahead: `__main__` needs `interrupt` within
milliseconds, before rich and tyro are read.
"""
