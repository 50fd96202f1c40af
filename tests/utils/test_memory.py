import platform
import subprocess
import sys

import pytest

FAULTS = """
import resource
from nerfdiff.utils.memory import keep_freed_memory
faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt
{call}
bytearray(2**24)  # the first block is new in any case
before = faults()
for _ in range(10):
    bytearray(b"x") * 2**24
print(faults() - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of glibc's malloc")
def test_a_large_block_comes_with_its_pages_the_second_time():
    def faults(call: str) -> int:
        code = FAULTS.format(call=call)
        return int(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)

    assert faults("keep_freed_memory()") < 0.2 * faults("")
