"""`us-sim` as a process of its own."""

import subprocess
import sys


def us_sim(*args: object, **kwargs: object) -> subprocess.CompletedProcess[str]:
    """`us-sim ARGS` to its end."""
    return subprocess.run(
        [sys.executable, "-m", "us_sim", *map(str, args)],
        capture_output=True,
        text=True,
        timeout=150,
        check=False,
        **kwargs,
    )
