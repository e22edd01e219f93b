"""Which libLLVM is taken on a machine without the wheel that brings one."""

import sys

import pytest

from benchsim import llvm


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine whose libraries lie in a folder, as Debian, Fedora and Homebrew lay them; returns how to add one."""
    monkeypatch.setattr(llvm, "_of_the_wheel", lambda: None)
    monkeypatch.setitem(
        llvm.PLACES,
        sys.platform,
        (f"{tmp_path}/*/libLLVM*", f"{tmp_path}/*/*/libLLVM*", f"{tmp_path}/*/bin/LLVM-C.dll"),
    )

    def add(path, link=None):
        file = tmp_path / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.symlink_to(tmp_path / link) if link else file.touch()
        return str(file)

    return add


def test_the_newest_is_taken(machine):
    machine("llvm-15/libLLVM-15.so.1")
    machine("x/libLLVM.so.19.1")
    newest = machine("x/libLLVM.so.20.1")
    assert llvm.find() == newest


def test_what_is_too_old_is_not_taken_by_whatever_name(machine):
    machine("llvm-14/libLLVM-14.so.1")
    machine("x/libLLVM.so", link="llvm-14/libLLVM-14.so.1")
    machine("x/libLLVM.so.18.1")
    assert llvm.find() is None


def test_a_version_may_stand_in_the_folder_alone(machine):
    machine("llvm@18/libLLVM.dylib")
    newest = machine("llvm/21.1.3/libLLVM.dylib")
    assert llvm.find() == newest


def test_windows_names_none(machine):
    assert llvm.find() is None
    only = machine("LLVM/bin/LLVM-C.dll")
    assert llvm.find() == only
