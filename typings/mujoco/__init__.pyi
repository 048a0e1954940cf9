"""MuJoCo ships no stubs that pyright can read: its names are taken as they come."""

from typing import Any

def __getattr__(name: str) -> Any: ...
