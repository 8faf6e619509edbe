"""The command line `push-ident`."""
