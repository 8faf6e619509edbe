"""One-page HTML reports: one look, one file, nothing loaded from elsewhere."""
