"""The one error that users see: what, where, expected, found, what to do.

The command line prints it on one line and exits with status 2; library callers catch `JaxsrError`.
"""


class JaxsrError(ValueError):
    """Bad input. The message is a single line that names the place, the expectation and the remedy.

    Args:
        what: the problem in a few words, for instance "missing channel 'normal.X'".
        where: file, frame, part or argument.
        expected: what would have been right.
        found: what was there instead.
        fix: what the user can do about it.
    """

    def __init__(
        self,
        what: str,
        *,
        where: object = None,
        expected: object = None,
        found: object = None,
        fix: str | None = None,
    ):
        self.what, self.where, self.expected, self.found, self.fix = what, where, expected, found, fix
        parts = [what if where is None else f"{where}: {what}"]
        if expected is not None:
            parts.append(f"expected {expected}")
        if found is not None:
            parts.append(f"found {found}")
        if fix is not None:
            parts.append(fix)
        super().__init__(" ".join("; ".join(parts).split()))
