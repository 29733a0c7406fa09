"""What can go wrong in the app itself; sources have their own named errors."""

from __future__ import annotations


class AppError(Exception):
    """Something a person can put right; the message says what, where and what next."""


class UsageError(AppError):
    """The command was typed wrongly."""


class ViewerError(AppError):
    """The viewer cannot be reached or started."""
