"""What a run used: its CPU time and its memory at the most, as the kernel counts them."""

import resource

from .link import Frame


def cpu_s() -> float:
    """Return the CPU time, user and system, of this process and of those it has waited for, seconds."""
    here, below = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return here.ru_utime + here.ru_stime + below.ru_utime + below.ru_stime


def own(since_s: float) -> Frame:
    """Return what this process, and those it has waited for, used since its CPU time was `since_s`."""
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return _frame(cpu_s() - since_s, max(resource.getrusage(kind).ru_maxrss for kind in kinds))


def of_reaped(used: resource.struct_rusage) -> Frame:
    """Return what a process used that has ended, with those it had waited for."""
    return _frame(used.ru_utime + used.ru_stime, used.ru_maxrss)


def _frame(seconds: float, peak_kib: int) -> Frame:
    return {"cpu_ms": round(max(0.0, seconds) * 1e3, 1), "peak_mb": round(peak_kib / 1024, 1)}
