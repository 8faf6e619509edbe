"""Identification of many bags on many machines, through Ray."""

from push_ident.fleet.job import FleetOptions, Job, find_jobs
from push_ident.fleet.page import write_index
from push_ident.fleet.run import FleetProgress, run_fleet
from push_ident.fleet.table import read_table, write_table

__all__ = ["FleetOptions", "FleetProgress", "Job", "find_jobs", "read_table", "run_fleet", "write_index", "write_table"]
