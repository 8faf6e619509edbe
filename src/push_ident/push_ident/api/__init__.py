"""The package as a library: the functions that `import push_ident` offers, and their figures."""
