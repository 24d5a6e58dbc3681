"""What the repository and its wheel must hold: who imports whom, package data, entry points, container files."""

from __future__ import annotations

import importlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
PACKAGES = ("service", "models_export", "clients", "benchmarks")
SCRIPTS = ("scripts/setup", "scripts/check", ".ci/run")


def commands() -> Iterator[str]:
    """Every ``module:object`` that pyproject.toml names."""
    yield from PROJECT["project"]["scripts"].values()
    for group in PROJECT["project"]["entry-points"].values():
        yield from group.values()


def test_nobody_imports_whom_they_must_not() -> None:
    linter = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    done = subprocess.run([sys.executable, "-c", linter, "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"Contracts: [1-9]\d* kept, 0 broken", done.stdout)


@pytest.mark.parametrize("reference", sorted(set(commands())))
def test_every_command_exists(reference: str) -> None:
    module, _, name = reference.partition(":")
    assert callable(getattr(importlib.import_module(module), name))


def test_installing_the_service_brings_no_training_library() -> None:
    names = {re.match(r"[\w.-]+", line)[0].lower() for line in PROJECT["project"]["dependencies"]}  # type: ignore[index]
    assert names.isdisjoint({"torch", "onnx", "onnxscript", "moderngl", "matplotlib"})


def test_package_roots_hold_nothing_but_the_version() -> None:
    for package in PACKAGES:
        for path in (ROOT / package).rglob("__init__.py"):
            text = path.read_text("utf-8").strip()
            assert re.fullmatch(r'(__version__ = "[^"]+")?', text), f"{path}: import from the module that defines the thing"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """The wheel, built from a copy, so that nothing is left in the working tree."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    build = f"from setuptools import build_meta; build_meta.build_wheel({str(out)!r})"
    done = subprocess.run([sys.executable, "-c", build], cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return zipfile.ZipFile(next(out.glob("*.whl")))


@pytest.mark.parametrize(
    ("folder", "pattern"),
    [
        ("service/api", "viewer*.*"),
        ("service/models", "**/*.onnx"),
        ("service/models", "**/manifest.json"),
        ("clients/clip", "**/*.*"),
    ],
)
def test_the_wheel_holds_all_data(wheel: zipfile.ZipFile, folder: str, pattern: str) -> None:
    shipped = set(wheel.namelist())
    expected = {path.relative_to(ROOT).as_posix() for path in (ROOT / folder).glob(pattern) if path.is_file()}
    assert expected
    assert expected <= shipped, sorted(expected - shipped)[:5]


def test_the_wheel_holds_all_modules_and_the_licence(wheel: zipfile.ZipFile) -> None:
    shipped = set(wheel.namelist())
    modules = {path.relative_to(ROOT).as_posix() for package in PACKAGES for path in (ROOT / package).rglob("*.py")}
    assert modules <= shipped, sorted(modules - shipped)
    assert any(name.endswith("licenses/LICENSE") for name in shipped)
    assert not any(name.startswith("tests/") for name in shipped)


def test_the_container_is_built_from_all_packages() -> None:
    dockerfile = (ROOT / "Dockerfile").read_text("utf-8")
    let_through = (ROOT / ".dockerignore").read_text("utf-8").splitlines()
    for package in PACKAGES:
        assert f"COPY {package} {package}\n" in dockerfile
        assert f"!{package}" in let_through
    assert re.search(r"^USER quadlift$", dockerfile, re.MULTILINE)


@pytest.mark.parametrize("script", SCRIPTS)
def test_scripts_run(script: str) -> None:
    assert os.access(ROOT / script, os.X_OK)
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("needs bash")
    subprocess.run([bash, "-n", str(ROOT / script)], check=True)


def test_the_viewer_refers_to_nothing_outside() -> None:
    pages = sorted((ROOT / "service" / "api").glob("viewer*.*"))
    assert len(pages) > 2
    for page in pages:
        # The namespace of SVG is a name, not an address that is fetched.
        text = page.read_text("utf-8").replace("http://www.w3.org/2000/svg", "")
        assert not re.search(r"(https?:)?//\w+\.\w+", text), page
