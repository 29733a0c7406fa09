"""`python -m selective_depth.app` is the command `selective-depth`."""

from selective_depth.app.cli import main

if __name__ == "__main__":
    main()
