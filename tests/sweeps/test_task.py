import platform
import subprocess
import sys

import pytest

JOBS = """
from omegaconf import OmegaConf
from nerfdiff.utils.memory import peak_memory
from nerfdiff.sweeps.task import Task

def job(cfg):
    block = bytearray(b"x") * cfg.size
    return peak_memory()

task = Task(job)
print(task(OmegaConf.create({"size": 2**28})), task(OmegaConf.create({"size": 2**20})))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc" or sys.platform != "linux", reason="of Linux with glibc")
def test_a_jobs_peak_memory_is_its_own():
    done = subprocess.run([sys.executable, "-c", JOBS], capture_output=True, text=True, check=True)
    large, small = map(int, done.stdout.split())
    assert large > 2**28 and small < large - 0.9 * 2**28
