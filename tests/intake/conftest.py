"""Pictures as a phone makes them, and this folder on the path."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def phone(tmp_path):
    """Three settings, each a photograph and its dark picture; names do not tell which is which."""
    from phone_pictures import picture, save

    folder = tmp_path / "photos"
    folder.mkdir()
    for i, column in enumerate((100, 160, 220)):
        save(folder / f"IMG_{2 * i + 8}.jpg", picture(column, seed=2 * i), 60.0 * i)
        save(folder / f"IMG_{2 * i + 9}.jpg", picture(None, seed=2 * i + 1), 60.0 * i + 20)
    return folder
