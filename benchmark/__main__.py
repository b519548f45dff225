"""`python -m semstab`: the command line."""

from semstab.cli import main

if __name__ == "__main__":
    main()
