"""`python -m relightcli`."""

from relightcli.cli.main import main

if __name__ == "__main__":
    main()
