"""What ``load_backgrounds`` refuses before it opens a file."""

import pytest

from sb3_abisim.envs.backgrounds.load import load_backgrounds


@pytest.mark.parametrize(
    "kwargs", [{"eval_fraction": 0.0}, {"eval_fraction": 1.0}, {"min_frames": 1}, {"on_error": "ignore"}]
)
def test_unknown_settings(tmp_path, kwargs):
    (name, value), *_ = kwargs.items()
    with pytest.raises(ValueError, match=f"{name} must .*{value}"):
        load_backgrounds(tmp_path, **kwargs)


def test_unknown_split():
    with pytest.raises(ValueError, match="'test'"):
        load_backgrounds(split="test")
