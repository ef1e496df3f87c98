"""`python -m imagine`: the same as the `imagine` command."""

from imagine.cli import main

if __name__ == "__main__":
    main()
