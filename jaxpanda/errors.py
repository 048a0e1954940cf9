"""The one error a user can cause."""


class InputError(ValueError):
    """Bad input: one clear sentence that says what, where (file, column, row) and what would work.

    The commands print it on standard error and end with exit status 2.
    """


class MissingExtraError(InputError):
    """An optional dependency is absent; names the extra that brings it."""

    def __init__(self, what: str, extra: str):
        super().__init__(f"{what} needs the extra [{extra}]: pip install 'jaxpanda[{extra}]'")


def require_x64(stage: str) -> None:
    """Refuse float32 where ranks are decided."""
    import jax

    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError(f"{stage} needs float64: call jax.config.update('jax_enable_x64', True) first")
