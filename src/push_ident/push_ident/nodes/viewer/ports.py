"""Default ports of the live view; no ROS, so that commands can name them."""

from __future__ import annotations

from typing import Final

__all__ = ["GRPC_PORT", "WEB_PORT"]

WEB_PORT: Final = 9090
"""Of the page for browsers."""
GRPC_PORT: Final = 9876
"""Of the data."""
