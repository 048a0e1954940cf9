"""Strict in tests, relaxed for users: float64, warnings as errors, shapes checked at run time."""

import os
from pathlib import Path

import jax
import pytest

jax.config.update("jax_enable_x64", True)


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real recordings; tests that need it are skipped where it is absent."""
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("JAXPANDA_DATA") or default)
    if not folder.is_dir():
        pytest.skip("no real recordings here: set JAXPANDA_DATA to the folder that holds them")
    return folder
