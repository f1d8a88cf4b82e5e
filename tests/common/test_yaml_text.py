"""YAML is data of bounded size."""

from pathlib import Path

import pytest

from sb3_abisim.common.yaml_text import MAX_BYTES, MAX_NODES, load_yaml, read_yaml_file


def test_anchors_are_read_as_long_as_they_are_few() -> None:
    assert load_yaml("a: &x {b: [1, 2]}\nc: *x\nd:\n  <<: *x\n") == {"a": {"b": [1, 2]}, "c": {"b": [1, 2]},
                                                                   "d": {"b": [1, 2]}}  # fmt: skip
    assert load_yaml("") is None


@pytest.mark.parametrize("mapping", [False, True])
def test_a_text_that_stands_for_more_than_memory(mapping: bool) -> None:
    lines = ["a0: &a0 {k: v}"]
    for k in range(1, 30):
        named = ", ".join([f"*a{k - 1}"] * 9)
        lines.append(f"a{k}: &a{k} " + (f"{{<<: [{named}]}}" if mapping else f"[{named}]"))
    with pytest.raises(ValueError, match=f"more than {MAX_NODES} nodes"):
        load_yaml("\n".join(lines))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a: &x [*x]", "more than 50000 nodes"),
        (b"[" * 50_000, "cannot read"),
        (b"#" * (MAX_BYTES + 1), "more than 262144"),
        (b"a: !!python/object/apply:os.system [ls]", "could not determine a constructor"),
        (b"\xff", "cannot read"),
        (b"a: [", "cannot read"),
        (b"a: 2001-99-99", "cannot read"),
        (b"{[1]: 2}", "cannot read"),
    ],
)
def test_refusals_name_the_file(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "x.yml").write_bytes(content)
    with pytest.raises(ValueError, match=message) as refused:
        read_yaml_file(tmp_path / "x.yml")
    assert f"cannot read {tmp_path / 'x.yml'} (" in str(refused.value) and "\n" not in str(refused.value)
