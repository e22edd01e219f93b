"""What a check has to say: what is missing, what is inconsistent, and what is worth knowing."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Kind(StrEnum):
    """Of a finding; a recording with none of the first two can be used."""

    missing = "missing"
    inconsistent = "inconsistent"
    remark = "remark"


@dataclass(frozen=True)
class Finding:
    """One sentence: ``where`` is a key or a picture, ``says`` what is amiss and the mend."""

    kind: Kind
    where: str
    says: str
