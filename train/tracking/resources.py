"""What a run takes and what it runs on, without names of people, hosts or folders."""

from __future__ import annotations

import os
import platform
import resource
from pathlib import Path
from typing import Any

import torch

_MB = 1e6


def memory_mb() -> dict[str, float]:
    """Return the resident memory of this process now and at its most, and the GPU's where there is one, in MB."""
    peak_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    memory = {"resident_mb": peak_kb * 1024 / _MB, "peak_mb": peak_kb * 1024 / _MB}
    try:
        pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
        memory["resident_mb"] = pages * os.sysconf("SC_PAGE_SIZE") / _MB
    except OSError:
        pass  # not Linux: the peak stands for both
    if torch.cuda.is_available():
        memory["gpu_mb"] = torch.cuda.memory_allocated() / _MB
        memory["gpu_peak_mb"] = torch.cuda.max_memory_allocated() / _MB
    return memory


def machine() -> dict[str, Any]:
    """Return processor, cores this process may use, memory and GPU: what speed and last bits depend on."""
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gb": round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9, 1),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def _cpu_model() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text("utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
