"""Which versions are told."""

from importlib import metadata

import jaxpanda


def test_sources_that_were_never_installed_have_a_version(monkeypatch):
    """A diagnosis of minutes was lost at its last step, as the page names versions."""

    def absent(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", absent)
    assert jaxpanda.__version__ == "unknown"
