"""Identification of many bags on many machines, through Ray."""

from push_ident.fleet.job import FleetOptions, Job, find_jobs
from push_ident.fleet.page import write_index
from push_ident.fleet.run import run_fleet
from push_ident.fleet.table import write_table

__all__ = ["FleetOptions", "Job", "find_jobs", "run_fleet", "write_index", "write_table"]
