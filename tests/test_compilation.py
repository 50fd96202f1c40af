import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from model_fixtures import model
from nerfdiff.compilation import CACHE_VARIABLE, compile_unets
from nerfdiff.utils.errors import ConfigError

TESTS = Path(__file__).parent


def run(backend: str, cache: Path) -> subprocess.CompletedProcess:
    env = {key: value for key, value in os.environ.items() if key not in (CACHE_VARIABLE, "TRITON_INTERPRET")}
    env["PYTHONPATH"] = f"{TESTS.parent / 'src'}{os.pathsep}{TESTS}"
    command = [sys.executable, str(TESTS / "compiled_unets.py"), backend, str(cache)]
    return subprocess.run(command, env=env, capture_output=True, text=True, timeout=600)


def test_compiled_unets_train_and_sample_as_plain_ones(tmp_path):
    """Checkpointing, autocast, reused deep levels, copies and names of parameters included; nothing is generated."""
    done = run("eager", tmp_path)
    assert done.stdout.endswith("same\n"), done.stderr


@pytest.mark.skipif(shutil.which(os.environ.get("CXX", "g++")) is None, reason="generated code needs a C++ compiler")
def test_generated_code_gives_the_same_and_stays_on_disk(tmp_path):
    done = run("inductor", tmp_path / "cache")
    assert done.stdout.endswith("same\n"), done.stderr
    assert any((tmp_path / "cache").rglob("*.so"))


def test_not_to_compile_leaves_the_model_alone(tmp_path):
    net = model()
    compile_unets(net, "none", tmp_path)
    assert not any(module._compiled_call_impl for module in net.modules())


def test_another_choice_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="choose none, unets, blocks"):
        compile_unets(model(), "regions", tmp_path)
