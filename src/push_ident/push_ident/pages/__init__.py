"""HTML reports: one common layout, one self-contained file per report."""
