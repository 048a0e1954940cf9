"""What can go wrong that is no defect of ours, each one clear sentence."""

import textwrap


class InputError(ValueError):
    """Bad input: one clear sentence that says what, where (file, column, row) and what would work.

    The commands print it on standard error and end with exit status 2.
    """


class MissingExtraError(InputError):
    """An optional dependency is absent; names the extra that brings it."""

    def __init__(self, what: str, extra: str):
        super().__init__(f"{what} needs the extra [{extra}]: pip install 'jaxpanda[{extra}]'")


class OutputError(Exception):
    """The result cannot be kept though nothing is wrong with what was asked: a full disk, a broken one.

    The commands print it on standard error and end with exit status 1.
    """


class RankError(Exception):
    """Another process of a shared run failed; nothing is wrong with what this one was asked.

    The commands print it on standard error and end with exit status 1.
    """


def printable(text: str) -> str:
    """The text with what steers a terminal, breaks a line or is no character written out, as `\\x1b`."""
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text
    )


def reason(error: Exception) -> str:
    """What a library says, as part of a sentence: on one line, and not longer than one reads."""
    return printable(textwrap.shorten(str(error), 200, placeholder="…"))


def require_x64(stage: str) -> None:
    """Refuse float32 where ranks are decided."""
    import jax

    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError(f"{stage} needs float64: call jax.config.update('jax_enable_x64', True) first")
