"""Errors that are the user's mistakes."""


class UserError(Exception):
    """A mistake that the user can fix; the message says what is wrong and what would be right."""
