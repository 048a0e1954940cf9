"""Which versions of packages are at work."""

from importlib import metadata


def version(package: str) -> str:
    """Of an installed package; "unknown" where it runs from its sources alone."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"
