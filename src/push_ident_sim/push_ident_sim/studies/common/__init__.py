"""What studies share: the runners, tables and figures, the report, measures, and live processes."""
