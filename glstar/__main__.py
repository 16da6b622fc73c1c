"""``python -m glstar``: the command line."""

from glstar.cli import main

if __name__ == "__main__":
    main()
