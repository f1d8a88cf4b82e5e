"""Where the name of an encoder leads: a path, a shipped file, the Hub."""

import sys
import types
from pathlib import Path

import pytest

from sb3_abisim.networks import encoder_name
from sb3_abisim.networks.encoder_name import EncoderNotFoundError, pinned_name, resolve_encoder


def test_resolve_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shipped, here = tmp_path / "shipped", tmp_path / "here"
    for folder in (shipped / "Nav2D-v0", here):
        folder.mkdir(parents=True)
    monkeypatch.setattr(encoder_name, "resource_path", lambda kind: {"encoders": shipped}[kind])
    monkeypatch.chdir(here)
    (shipped / "Nav2D-v0" / "ssi.safetensors").touch()
    assert resolve_encoder("Nav2D-v0/ssi") == shipped / "Nav2D-v0" / "ssi.safetensors"
    with pytest.raises(EncoderNotFoundError) as raised:
        resolve_encoder("Nav2D-v0/abisim")
    name = "Nav2D-v0/abisim"
    assert str(raised.value) == (
        f"no encoder file '{name}'; searched {here / name}, {shipped / name}, {shipped / name}.safetensors. Shipped "
        "encoders: Nav2D-v0/ssi. Correct the name, or write the file with sb3-abisim pretrain"
    )
    (shipped / "Nav2D-v0" / "acro.safetensors").touch()
    with pytest.raises(EncoderNotFoundError, match=r"Shipped encoders: Nav2D-v0/acro, Nav2D-v0/ssi\. "):
        resolve_encoder(name)
    monkeypatch.setattr(encoder_name, "resource_path", lambda kind: here)
    with pytest.raises(EncoderNotFoundError, match=r"Shipped encoders: none\. "):
        resolve_encoder(name)
    monkeypatch.setattr(encoder_name, "resource_path", lambda kind: shipped)
    (here / "Nav2D-v0").mkdir()
    (here / "Nav2D-v0" / "ssi").touch()
    assert resolve_encoder("Nav2D-v0/ssi") == here / "Nav2D-v0" / "ssi"
    with pytest.raises(
        ValueError,
        match=r"^encoder must be a path, the name of a shipped encoder or hf://owner/repository, got ''$",
    ):
        resolve_encoder("")


def test_pinned_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("Nav2D-v0/ssi", "a/path", str(tmp_path)):
        assert pinned_name(name) == name
    commit = "0a" * 20
    folder = tmp_path / "models--me--repo" / "snapshots" / commit
    hub = types.SimpleNamespace(hf_hub_download=lambda repo_id, filename, revision: str(folder / filename))
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    for name in ("hf://me/repo", "hf://me/repo@main", "hf://me/repo/model.safetensors", f"hf://me/repo@{commit}"):
        assert pinned_name(name) == f"hf://me/repo@{commit}"
    assert pinned_name("hf://me/repo/a/b.safetensors") == f"hf://me/repo@{commit}/a/b.safetensors"
    folder = tmp_path
    with pytest.raises(ValueError, match="does not say of which commit it is; give the name as hf://me/repo@COMMIT"):
        pinned_name("hf://me/repo")


def test_hub_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def hf_hub_download(repo_id: str, filename: str, revision: str | None) -> str:
        calls.append((repo_id, filename, revision))
        if filename == "absent":
            raise OSError("404 entry not found")
        return str(tmp_path / filename)

    hub = types.SimpleNamespace(hf_hub_download=hf_hub_download)
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    assert resolve_encoder("hf://me/repo/a/b.safetensors") == tmp_path / "a/b.safetensors"
    assert resolve_encoder("hf://me/repo@v1/b") == tmp_path / "b"
    with pytest.raises(EncoderNotFoundError, match=r"hf://me/repo/absent.*404"):
        resolve_encoder("hf://me/repo/absent")
    assert resolve_encoder("hf://me/repo") == tmp_path / "model.safetensors"
    assert resolve_encoder("hf://me/repo@v1") == tmp_path / "model.safetensors"
    assert calls == [
        ("me/repo", "a/b.safetensors", None), ("me/repo", "b", "v1"), ("me/repo", "absent", None),
        ("me/repo", "model.safetensors", None), ("me/repo", "model.safetensors", "v1"),
    ]  # fmt: skip
    for name in ("hf://", "hf://me", "hf:///x/y", "hf://me/repo@", "hf://me@v1/repo"):
        with pytest.raises(ValueError, match="looks like"):
            resolve_encoder(name)
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(EncoderNotFoundError, match=r"pip install 'sb3_abisim\[hub\]'"):
        resolve_encoder("hf://me/repo/b")
