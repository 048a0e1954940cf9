"""Which versions are told."""

from importlib import metadata

import jax
import pytest

import jaxpanda
from jaxpanda import xla
from jaxpanda.validation import jit_mjx


def test_sources_that_were_never_installed_have_a_version(monkeypatch):
    """A diagnosis of minutes was lost at its last step, as the page names versions."""

    def absent(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", absent)
    assert jaxpanda.__version__ == "unknown"


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="options of a CPU's compiler")
@pytest.mark.parametrize("known", [True, False])
def test_compiler_options_are_those_that_xla_knows(known, monkeypatch):
    if not known:
        monkeypatch.setattr(xla, "_ON_CPU", {"xla_option_of_another_version": True})
    clear = lambda: [f.cache_clear() for f in (xla.options, xla.options_of_solver)]
    clear()
    assert (xla.options() is not None) == known
    assert xla.options("gpu") is None
    assert xla.options_of_solver("cpu") == xla.options("cpu")
    assert jit_mjx(lambda x: 2 * x)(0.5) == 1.0
    clear()
