"""The user's mistakes."""


class UserError(Exception):
    """Something that the user can put right; its text says what is wrong and what would be right."""
