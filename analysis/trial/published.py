"""The published trial: run it with a fresh seed, keep what a referee needs, make its recordings again.

python analysis/trial/published.py run out/trial --cases 150 --key ~/trial-key
python analysis/trial/published.py keep out/trial      # and its table into README.md
python analysis/trial/published.py again out/again
"""

from __future__ import annotations

import argparse
import json
import tarfile
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any

from benchsim import trial
from benchsim.bench.writing import write_text
from benchsim.trial import ledger
from benchsim.trial.score import KIND_WORDS

KEPT = Path(__file__).resolve().parent / "kept.tar.xz"
"""Of the folder ``kept``: truths, verdicts, ledgers, score and page."""

BEGIN, END = "<!-- table: written by 'published.py keep' -->", "<!-- end of table -->"

OUTCOMES = {
    "right": "right",
    "class": "left open, truth among it",
    "missed": "missed",
    "wrong": "wrong",
    "": "no verdict",
}


def keep(folder: Path) -> None:
    """Pack the trial without the pictures of its recordings; put the tables in the README."""
    trial.verify(folder)
    packed = KEPT.with_suffix(".part")
    with tarfile.open(packed, "w:xz", preset=9) as tar:
        tar.add(folder, "kept", filter=_readable)
    packed.replace(KEPT)
    readme = KEPT.with_name("README.md")
    before, rest = readme.read_text(encoding="utf-8").split(BEGIN)
    score = json.loads((folder / "score.json").read_text(encoding="utf-8"))
    write_text(readme, before + "\n\n".join([BEGIN, *tables(score), END]) + rest.split(END)[1])
    with unpacked() as kept:
        print(trial.verify(kept, recordings=False).summary())


def _readable(part: tarfile.TarInfo) -> tarfile.TarInfo | None:
    if part.name.endswith(".png"):
        return None
    # Truths are sealed until a trial is opened.
    part.mode = 0o755 if part.isdir() else 0o644
    return part


@contextmanager
def unpacked() -> Iterator[Path]:
    """What was kept, in a folder that goes again."""
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(KEPT) as tar:
            # Python 3.11 has filters from its fourth release on; the archive is our own.
            tar.extractall(folder, **({"filter": "data"} if hasattr(tarfile, "data_filter") else {}))
        yield Path(folder) / "kept"


def tables(score: dict[str, Any]) -> list[str]:
    """Outcomes by what was concealed, the bars, and every case that was not found rightly, in Markdown."""
    cases = score["cases"]
    counts = {row: Counter(c["cause"] for c in group) for row, group in _by_row(cases)}
    used = [o for o in OUTCOMES if any(of[o] for of in counts.values())]
    outcomes = _table(
        ["concealed", "cases", *(OUTCOMES[o] for o in used)],
        [[KIND_WORDS[row], sum(of.values()), *(of[o] for o in used)] for row, of in counts.items()],
    )
    bars = _table(
        ["bar", "asked", "found", "95 % interval", "n", ""],
        [[b["quantity"], b["bar"], b["value"], b["interval"], b["n"], b["state"]] for b in score["bars"]],
    )
    misses = _table(
        ["case", "concealed", "SNR", "nearest rival (σ)", "said", "outcome"],
        [
            [
                c["case"],
                c["concealed"],
                "" if c["snr"] is None else f"{c['snr']:.1f}",
                "" if c["rival_sigma"] is None else f"{c['rival_sigma']:.1f}",
                c["said"],
                f"{c['cause']}: {c['note']}" if c["note"] else c["cause"],
            ]
            for c in cases
            if c["cause"] != "right"
        ],
    )
    found = score["leak"]
    leak = f'Leak test: best clue "{found["clue"]}", AUC {found["auc"]:.2f}, p = {found["p_value"]:.3f}.'
    return [score["headline"], outcomes, bars, leak, "Every case that was not found rightly:", misses]


def _by_row(cases: list[dict[str, Any]]) -> Any:
    order = list(KIND_WORDS)
    return groupby(sorted(cases, key=lambda c: order.index(c["row"])), key=lambda c: c["row"])


def _table(head: list[str], rows: list[list[Any]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |" for line in lines)


def again(folder: Path) -> None:
    """Conceal the same trial from its opened seed, and say how many recordings and truths are the same to the byte."""
    with unpacked() as kept:
        plan = json.loads((kept / "truth" / "plan.json").read_text(encoding="utf-8"))
        was = ledger.standing(ledger.read(kept / "recordings" / ledger.NAME)).concealed
    trial.conceal(folder, len(plan["kinds"]), seed=int(plan["seed"], 16), shrink=plan["shrink"], zero=plan["zero"])
    now = ledger.standing(ledger.read(folder / "recordings" / ledger.NAME)).concealed
    for what, key in (("recordings", "files"), ("truths", "commitment")):
        same = [case for case in was if was[case][key] == now[case][key]]
        print(f"{len(same)} of {len(was)} {what} are the same to the byte")


def main() -> None:
    """Run, keep, or make again."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["run", "keep", "again"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cases", type=int, default=150)
    parser.add_argument("--workers", type=int, default=None)
    parser.add_argument("--key", type=Path, default=None, help="signs recordings and verdicts")
    args = parser.parse_args()
    if args.what == "run":
        print(trial.run(args.folder, args.cases, workers=args.workers, key=args.key).summary())
    elif args.what == "keep":
        keep(args.folder)
    else:
        again(args.folder)


if __name__ == "__main__":
    main()
