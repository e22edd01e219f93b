"""Imports point one way, and the two realisations of the bench never meet.

The walk covers every import statement of every module, those inside functions too.
"""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1] / "benchsim"

ALLOWED = {
    "bench": set(),
    "boards": {"bench"},
    "calibration": {"bench", "trace"},
    "intake": {"bench", "calibration", "trace", "vector"},
    "vector": {"bench"},
    "rays": {"bench"},
    "trace": {"bench"},
    "conics": {"bench"},
    "diagnosis": set(),
    "renderer": {"bench"},
    "reports": {"bench", "calibration", "diagnosis", "rays", "trace", "conics", "vector", "plant"},
    "instruments": {"bench", "diagnosis", "rays", "trace", "conics", "vector"},
    "arrays": {"bench", "vector"},
    "drones": {"bench", "renderer"},
    "fluxes": {"bench", "vector", "instruments", "renderer"},
    "plant": {"bench", "fluxes", "instruments"},
    "jobs": {
        "bench",
        "boards",
        "calibration",
        "intake",
        "diagnosis",
        "rays",
        "trace",
        "conics",
        "vector",
        "reports",
        "renderer",
        "instruments",
        "fluxes",
        "plant",
        "arrays",
        "drones",
    },
    "llvm": set(),
    "api": {"bench", "jobs"},
    "trial": {"bench", "diagnosis", "rays", "renderer", "instruments", "jobs"},
    "cli": {"bench", "jobs", "trial"},
}
"""Room → rooms it may import. ``reports`` sees the result types of the rooms below it."""


def imported(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; write the full name"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def rooms_of(names: set[str]) -> set[str]:
    return {name.split(".")[1] for name in names if name.startswith("benchsim.") and name.count(".") >= 1} - {
        "__version__",
        "llvm_import_order",
    }


def room(path: Path) -> str:
    return path.relative_to(ROOT).with_suffix("").parts[0]


MODULES = sorted(ROOT.rglob("*.py"))


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_one_way(path):
    own = room(path)
    if own in ("__init__", "__main__"):
        return
    assert own in ALLOWED, f"{own} is no room of the design"
    known = set(ALLOWED)
    for other in rooms_of(imported(path)) & known - {own}:
        assert other in ALLOWED[own], (
            f"{path.relative_to(ROOT)} imports {other}; {own} may import {sorted(ALLOWED[own])}"
        )


def test_the_walk_sees_a_forbidden_import(tmp_path):
    bad = tmp_path / "bad.py"
    bad.write_text("def f():\n    from benchsim.rays import trace\n    import benchsim.renderer.board\n")
    assert rooms_of(imported(bad)) == {"rays", "renderer"}


def test_the_package_itself_imports_nothing_heavy():
    first = [ROOT / "__init__.py", *(ROOT / "cli").glob("*.py")]
    names = set().union(*map(imported, first))
    heavy = {"mitsuba", "drjit", "numpy", "scipy", "cv2", "matplotlib", "skimage", "pvlib"}
    top = [n for path in first for n in ast.parse(path.read_text()).body]
    at_top = {a.name.split(".")[0] for n in top if isinstance(n, ast.Import) for a in n.names}
    at_top |= {n.module.split(".")[0] for n in top if isinstance(n, ast.ImportFrom) and n.module}
    assert not heavy & {n.split(".")[0] for n in names}
    assert not heavy & at_top
