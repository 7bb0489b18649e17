"""How many files a process may hold open."""

import resource

_OTHERS = 256  # descriptors that libraries, workers and sockets need besides


def files_to_hold(wanted: int) -> int:
    """How many of `wanted` files may be held open: all, where the system lets this process raise its own limit."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = wanted + _OTHERS
    if soft != resource.RLIM_INFINITY and soft < needed:
        raised = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, raised), hard))
        soft = max(soft, raised)
    return wanted if soft == resource.RLIM_INFINITY else min(wanted, max(soft - _OTHERS, 8))
