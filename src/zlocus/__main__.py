"""`python -m zlocus`, the same as the command."""

from zlocus.cli import main

if __name__ == "__main__":
    main()
