"""How large the diagnosis is to read: lines, code, modules, floors of imports, and constants.

    python analysis/diagnosis_size.py [--constants]

A constant is a number (or several) that a module gives a name in capitals; what is computed from named ones alone is
not counted. Code is what is neither blank, comment nor docstring. A module's floor is one above the highest that it
imports.
"""

import argparse
import ast
import io
import tokenize
from functools import cache
from pathlib import Path

ROOM = Path(__file__).resolve().parents[1] / "benchsim" / "diagnosis"
SEARCH = ("search", "explored", "starts", "naming", "fitting", "least_squares", "evidence", "decision")


def constants(tree: ast.Module) -> list[str]:
    """Names in capitals that hold numbers of their own."""
    found = []
    for node in tree.body:
        inside = list(ast.walk(node.value)) if isinstance(node, ast.Assign) else []
        derived = any(isinstance(n, ast.Name) and n.id.strip("_").isupper() for n in inside)
        if not derived and any(isinstance(n, ast.Constant) and isinstance(n.value, int | float) for n in inside):
            targets = [t for t in node.targets for t in (t.elts if isinstance(t, ast.Tuple) else [t])]
            found += [t.id for t in targets if isinstance(t, ast.Name) and t.id.strip("_").isupper()]
    return found


def code(text: str) -> int:
    """Lines that hold code."""
    docs = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            docs |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    silent = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
    used = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in silent:
            used |= set(range(token.start[0], token.end[0] + 1))
    return len(used - docs)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--constants", action="store_true", help="list them")
    listed = arguments.parse_args().constants
    texts = {p.stem: p.read_text(encoding="utf-8") for p in sorted(ROOM.glob("*.py")) if p.stem != "__init__"}
    trees = {m: ast.parse(t) for m, t in texts.items()}

    @cache
    def floor(module: str) -> int:
        below = set()
        for node in ast.walk(trees[module]):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("benchsim.diagnosis"):
                own = (node.module or "").split(".")[2:]
                below |= {*own} if own else {a.name for a in node.names}
        return 1 + max((floor(b) for b in below if b in trees), default=0)

    for title, some in (("diagnosis", list(texts)), ("search, solver, evidence, decision", [*SEARCH])):
        some = [m for m in some if m in texts]
        lines, bare = (sum(f(texts[m]) for m in some) for f in (lambda t: len(t.splitlines()), code))
        held = [f"{m}.{c}" for m in some for c in constants(trees[m])]
        top = max(map(floor, some))
        print(f"{title}: {lines} lines, {bare} of code, {len(some)} modules, {top} floors, {len(held)} constants")
        if listed:
            print("  " + "\n  ".join(held))


if __name__ == "__main__":
    main()
