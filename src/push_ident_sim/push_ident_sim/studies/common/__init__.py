"""What studies share: the runner, tables, figures and pages, measures, objects that are pushed."""
