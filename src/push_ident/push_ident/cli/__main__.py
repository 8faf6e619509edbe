"""`python -m push_ident.cli ...`: as `push-ident ...`."""

from push_ident.cli.entry import main

if __name__ == "__main__":
    main()
