"""Every stage timed, and the same work done elsewhere timed beside it."""
