"""`colcon test` runs pytest here; the tests are in test/ of the repository."""

from helpers.colcon_test import pytest_configure as pytest_configure
