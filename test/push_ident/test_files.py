"""Files are written whole, through no link, under no name that can be guessed, and private where they belong to one user."""

from __future__ import annotations

import ast
import errno
import os
import stat
import threading
from pathlib import Path

import pytest

from helpers.paths import SOURCE, nodes
from push_ident.errors import InputError, PushIdentError
from push_ident.files import make_folder, open_log, open_new, read_regular, replaced, write_whole


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.fixture(autouse=True)
def usual_umask() -> None:
    os.umask(0o022)


def test_a_private_file_and_its_new_folders_are_for_the_user_only_and_a_result_keeps_the_umask(tmp_path: Path) -> None:
    file = tmp_path / "state" / "objects" / "o1.json"
    write_whole(file, "{}", "the state", private=True)
    assert mode(file) == 0o600
    assert mode(file.parent) == mode(file.parent.parent) == 0o700
    file.chmod(0o644)
    write_whole(file, "{}", "the state", private=True)
    assert mode(file) == 0o600
    shared = tmp_path / "out" / "result.json"
    write_whole(shared, "{}", "the result")
    assert (mode(shared), mode(shared.parent)) == (0o644, 0o755)
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError):
        make_folder(tmp_path / "file", private=True)


def test_a_link_is_replaced_or_refused_and_what_it_points_to_is_left_alone(tmp_path: Path) -> None:
    victim, link = tmp_path / "victim", tmp_path / "result.json"
    victim.write_text("mine")
    link.symlink_to(victim)
    for open_it in (open_new, open_log):
        with pytest.raises(OSError):
            open_it(link)
    write_whole(link, "new", "the result")
    assert victim.read_text() == "mine"
    assert not link.is_symlink() and link.read_text() == "new"


def test_a_failure_leaves_the_old_file_and_nothing_else_and_each_temporary_name_is_another(tmp_path: Path) -> None:
    file, names = tmp_path / "model.json", set()
    write_whole(file, "old", "the model")

    def fail() -> None:
        with replaced(file, "the model") as part:
            part.write(b"half of the new")
            names.update(path.name for path in tmp_path.iterdir())
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    for _ in range(2):
        with pytest.raises(PushIdentError, match=r"Cannot write the model to .*: No space left on device; free some space\."):
            fail()
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file] and len(names) == 3


def test_writers_at_the_same_time_leave_one_whole_file(tmp_path: Path) -> None:
    file = tmp_path / "state.json"
    texts = [letter * 200_000 for letter in "abcdef"]
    threads = [threading.Thread(target=write_whole, args=(file, text, "the state")) for text in texts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert file.read_text() in texts
    assert list(tmp_path.iterdir()) == [file]


def test_a_name_that_no_file_can_have_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for path in (Path(""), Path("."), *(tmp_path / name for name in ("..", "a\0b", "x" * 300, "\ud800", "folder/"))):
        with pytest.raises(InputError) as refused:
            write_whole(path, "text", "the result", error=InputError)
        assert "\n" not in str(refused.value) and "\0" not in str(refused.value)


def test_pipes_devices_and_huge_files_are_not_read(tmp_path: Path) -> None:
    pipe, large = tmp_path / "pipe", tmp_path / "large"
    os.mkfifo(pipe)
    large.write_bytes(b"x" * 101)
    for path in (pipe, Path("/dev/zero"), tmp_path, large):
        with pytest.raises(OSError):
            read_regular(path, 100)
    assert read_regular(large, 101) == b"x" * 101


# ---- the sources

WRITERS = {
    "push_ident/files.py": "the one writer",
    "push_ident/bags/compression.py": "unpacks a compressed storage file into a folder with a random name",
    "push_ident/nodes/base/run.py": "/proc: how urgent the process is",
    "push_ident/physics/kernel.py": "the stamp of numba's cache, beside the sources",
    "push_ident/simulators/bullet_scene.py": "/dev/null, for what Bullet prints",
    "push_ident_sim/cell/world.py": "a description for Bullet, in a folder of its own with a random name",
    "push_ident_sim/studies/bench/engine.py": "/proc",
}


def constant_arguments(call: ast.Call) -> list[object]:
    return [a.value for a in (*call.args, *(k.value for k in call.keywords if k.arg == "mode")) if isinstance(a, ast.Constant)]


def test_only_one_module_writes_files_and_nothing_is_read_that_can_run_code() -> None:
    """Most of what runs code, ruff finds."""
    found = set()
    for path in (path for package in ("push_ident", "push_ident_sim") for path in (SOURCE / package / package).rglob("*.py")):
        for call in (node for node in nodes(path) if isinstance(node, ast.Call)):
            function = ast.unparse(call.func).rpartition(".")[2]
            opens = function == "open" and any(isinstance(m, str) and len(m) < 4 and set(m) & set("wax+") for m in constant_arguments(call))
            if function in ("write_text", "write_bytes") or opens:
                found.add(str(path.relative_to(SOURCE)).split("/", 1)[1])
            assert function not in ("unsafe_load", "full_load", "mktemp"), path
            assert all(ast.unparse(keyword.value) == "False" for keyword in call.keywords if keyword.arg == "allow_pickle"), path
    assert found == set(WRITERS) - {"push_ident/files.py"}, (
        "write with `write_whole`, `replaced`, `open_new` or `open_log` of push_ident.files"
    )
