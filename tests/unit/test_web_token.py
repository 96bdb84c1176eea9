"""The token's file: made once, private, refused where it is not."""

import json
import os
import stat
from pathlib import Path

import pytest
from command_line import caller

from elpd.errors import ConfigError
from elpd.web.token import read_or_make_token, read_token, token_path


def test_it_is_made_once_and_only_its_owner_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "new" / "web.token"
    token = read_or_make_token(path)
    assert len(token) >= 43
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert read_or_make_token(path) == token
    assert [entry.name for entry in path.parent.iterdir()] == ["web.token"]
    assert read_or_make_token(tmp_path / "another") != token


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660])
def test_a_token_that_others_can_read_is_refused(tmp_path: Path, mode: int) -> None:
    path = tmp_path / "web.token"
    read_or_make_token(path)
    path.chmod(mode)
    with pytest.raises(ConfigError, match=f"mode {mode:04o}.*delete it"):
        read_or_make_token(path)


def test_a_token_of_somebody_else_is_refused(tmp_path: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can give a file away")
    path = tmp_path / "web.token"
    read_or_make_token(path)
    os.chown(path, 12345, 12345)
    with pytest.raises(ConfigError, match="owner 12345"):
        read_or_make_token(path)


@pytest.mark.parametrize("content", ["", "short", "with spaces " * 8, "\x00" * 50])
def test_a_file_without_a_token_is_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "web.token"
    path.write_text(content)
    path.chmod(0o600)
    with pytest.raises(ConfigError, match="does not hold a token"):
        read_or_make_token(path)


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    real = tmp_path / "real"
    read_or_make_token(real)
    (tmp_path / "web.token").symlink_to(real)
    with pytest.raises(ConfigError, match=r"web\.token_file"):
        read_or_make_token(tmp_path / "web.token")


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"set web\.token_file"):
        read_or_make_token(tmp_path / "file" / "web.token")


def test_a_unit_keeps_it_in_its_own_state(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", f"{tmp_path}/one:{tmp_path}/two")
    assert token_path(None) == tmp_path / "one" / "web.token"
    assert token_path(Path("given")) == Path("given")
    monkeypatch.delenv("STATE_DIRECTORY")
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert token_path(None) == tmp_path / "elpd" / "web.token"


def test_the_link_holds_the_token_in_its_fragment(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    elpd = caller(capsys, monkeypatch, tmp_path)
    none = elpd("web", "--link", "--json", "--set", "web.token_file=here")
    assert none.code == 2
    assert "start `elpd web`" in none.json["error"]["message"]
    token = read_or_make_token(tmp_path / "here")
    answer = elpd("web", "--link", "--json", "--set", "web.token_file=here", "--set", "web.port=4711").json
    assert answer == {"address": f"http://127.0.0.1:4711/#token={token}", "token_file": "here"}
    assert elpd("web", "--link", "--set", "web.token_file=here").out == f"http://127.0.0.1:8732/#token={token}\n"


def test_the_link_of_the_service_is_for_root(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can give a file away")
    service = tmp_path / "service.token"
    token = read_or_make_token(service)
    os.chown(service, 12345, 12345)
    monkeypatch.setattr("elpd.web.token.SERVICE_TOKEN", service)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "of-nobody"))
    assert read_token(None) == (token, service)
    with pytest.raises(ConfigError, match="no token yet"):
        read_token(tmp_path / "configured")


def test_an_open_port_without_allowed_hosts_is_refused(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    answer = caller(capsys, monkeypatch, tmp_path)("web", "--json", "--set", "web.host=0.0.0.0")
    assert answer.code == 2
    assert "allowed_hosts" in answer.json["error"]["message"]


def test_a_port_that_is_taken_is_named(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    import socket  # noqa: PLC0415

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        answer = caller(capsys, monkeypatch, tmp_path)("web", "--json", "--set", f"web.port={port}")
    assert answer.code == 4
    assert f"127.0.0.1:{port}" in answer.json["error"]["message"]
    assert json.dumps(answer.json)
