import subprocess

import torch
from omegaconf import OmegaConf

from nerfdiff.results.environment import environment, git_state
from nerfdiff.results.row import ResultRow
from nerfdiff.utils.hashes import sha256_file, sha256_values


def git(folder, *arguments):
    identity = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
    done = subprocess.run(["git", *identity, *arguments], cwd=folder, check=True, capture_output=True, text=True)
    return done.stdout.strip()


def test_environment_fills_a_result_row():
    facts = environment("cpu", precision="32-true")
    filled = ResultRow(run_id="x", **facts)
    assert filled.device == "cpu" and filled.cuda is None and filled.precision == "32-true"
    assert filled.torch == torch.__version__ and filled.cpu
    assert filled.lightning.startswith("2.") and filled.hydra.startswith("1.")


def test_git_state_of_a_checkout(tmp_path):
    git(tmp_path, "init")
    (tmp_path / "code.py").write_text("1")
    (tmp_path / ".gitignore").write_text("venv/\n")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "first")
    head = git(tmp_path, "rev-parse", "HEAD")
    assert git_state(tmp_path) == {"git_sha": head, "git_dirty": False}
    (tmp_path / "code.py").write_text("2")
    assert git_state(tmp_path) == {"git_sha": head, "git_dirty": True}
    (tmp_path / "venv").mkdir()
    assert git_state(tmp_path / "venv") == {"git_sha": None, "git_dirty": None}


def test_without_git_there_is_no_sha(tmp_path, monkeypatch):
    assert git_state(tmp_path) == {"git_sha": None, "git_dirty": None}
    monkeypatch.setenv("PATH", "")
    assert git_state(tmp_path) == {"git_sha": None, "git_dirty": None}


def test_equal_settings_have_equal_digests():
    plain = {"model": {"width": 8, "half": 8}, "seed": 1}
    config = OmegaConf.create({"seed": 1, "model": {"half": "${model.width}", "width": 8}})
    assert sha256_values(plain) == sha256_values(config)
    assert sha256_values(plain) != sha256_values(plain | {"seed": 2})
    assert sha256_values(["a", "b"]) != sha256_values(["b", "a"])


def test_file_digest_is_that_of_sha256sum(tmp_path):
    (tmp_path / "abc").write_bytes(b"abc")
    expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180-2, appendix B.1
    assert sha256_file(tmp_path / "abc") == expected
