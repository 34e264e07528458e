"""`python -m morpheyes_daemon`: the same as the command `morpheyes`."""

from morpheyes_daemon.cli import main

if __name__ == "__main__":
    main()
