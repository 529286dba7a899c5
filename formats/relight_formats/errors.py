"""The root of all errors a user may see, and the leaf that speaks of stores."""


class RelightError(Exception):
    """Root of every error that is the user's to read: what was wrong, what was expected, what was found, what to do."""


class StoreError(RelightError):
    """A store that is damaged, incomplete for what was asked, of another version, locked, or made from other inputs."""


AGAIN = "Make it again (--overwrite)."
"""What to do about a damaged store."""
