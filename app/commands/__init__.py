"""One file a command or a family of them; the command line imports each when it is asked for."""
