"""The classes that the registry makes, in pickles and in saved models that another process loads."""

import copy
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import cloudpickle
import pytest
import stable_baselines3 as sb3
from extractor_inputs import RandomImages, build, write

from sb3_abisim import registry
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.objectives.ssi import InverseDynamics
from sb3_abisim.registry import methods
from sb3_abisim.rl.extractor_classes import extractor_class, method_of

ROOT = Path(__file__).resolve().parents[2]
# A package that adds a method, as users write them.
PACKAGE = """
from sb3_abisim import Objective, register_method

class Mine(Objective):
    pass

register_method("mine", Mine)
"""


class Foreign(InverseDynamics):
    """The objective of another package's method: this module is not one of sb3_abisim."""


def python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    variables = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)} | environment
    return subprocess.run([sys.executable, "-c", code], env=variables, capture_output=True, text=True)


@pytest.mark.parametrize("method", methods())
def test_classes_are_pickled_by_reference(method: str) -> None:
    made = extractor_class(method)
    for module in (pickle, cloudpickle):
        data = module.dumps(made)
        assert module.loads(data) is made
        # The module and the name, and no definition of a class.
        assert len(data) < 100 and made.__name__.encode() in data
    assert copy.deepcopy(made) is made


def test_an_unknown_class_is_no_attribute_error() -> None:
    """SB3's load turns an AttributeError into a warning, and fails later for another reason."""
    code = b"csb3_abisim.rl.extractors\nNobodysExtractor\n."
    with pytest.raises(
        ImportError, match=r"'NobodysExtractor', only .*SSIExtractor.*import the package that registers"
    ):
        pickle.loads(code)


def test_a_saved_model_loads_where_only_sb3_is_imported(tmp_path: Path) -> None:
    encoder = write(tmp_path / "e.safetensors")
    hash = load_encoder(encoder).hash
    model = build("PPO", encoder, False)
    model.save(tmp_path / "model.zip")
    encoder.unlink()
    code = "import sys; from stable_baselines3 import PPO; assert 'sb3_abisim' not in sys.modules; "
    code += f"print(PPO.load({str(tmp_path / 'model.zip')!r}, device='cpu').policy.features_extractor.hash)"
    done = python(code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == hash


def test_a_saved_model_of_another_packages_method(tmp_path: Path) -> None:
    (tmp_path / "my_package.py").write_text(PACKAGE)
    write(tmp_path / "e.safetensors", objective="mine")
    saved = str(tmp_path / "model.zip")
    code = f"""
import my_package, gymnasium as gym, sb3_abisim
from stable_baselines3 import PPO
kwargs = {{"features_extractor_class": sb3_abisim.MineExtractor}}
kwargs["features_extractor_kwargs"] = {{"encoder": {str(tmp_path / "e.safetensors")!r}}}
PPO("CnnPolicy", "Nav2D-v0", policy_kwargs=kwargs, device="cpu").save({saved!r})
"""
    done = python(code, PYTHONPATH=os.pathsep.join((str(ROOT), str(tmp_path))))
    assert done.returncode == 0, done.stderr
    (tmp_path / "e.safetensors").unlink()
    code = f"from stable_baselines3 import PPO; PPO.load({saved!r}, device='cpu')"
    # Neither run nor needed: the model names the module, and a user has to import it.
    for path in (str(ROOT), os.pathsep.join((str(ROOT), str(tmp_path)))):
        done = python(code, PYTHONPATH=path)
        assert done.returncode == 1 and "ImportError: no method has a features extractor 'MineExtractor'" in done.stderr
        assert "import my_package first (--packages my_package in a command)" in done.stderr
    done = python(f"import my_package; {code}", PYTHONPATH=os.pathsep.join((str(ROOT), str(tmp_path))))
    assert done.returncode == 0, done.stderr


def test_classes_of_another_packages_method(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(registry._METHODS, "by_name", methods())
    registry.register_method("other", Foreign)
    made: Any = extractor_class("other")
    assert made.__name__ == "OtherExtractor" and method_of(made) == "other" and made.objective == "other"
    data = cloudpickle.dumps(made)
    assert cloudpickle.loads(data) is made and copy.deepcopy(made) is made and b"test_extractor_pickles" in data
    encoder = write(tmp_path / "e.safetensors", objective="other")
    kwargs = {"features_extractor_class": made, "features_extractor_kwargs": {"encoder": str(encoder)}}
    sb3.PPO("CnnPolicy", RandomImages(), policy_kwargs=kwargs, device="cpu").save(tmp_path / "model.zip")
    loaded: Any = sb3.PPO.load(tmp_path / "model.zip", device="cpu")
    assert type(loaded.policy.features_extractor) is made

    # A class that somebody has written on top of it is pickled as any class: by value, or by reference to its module.
    class Derived(made):  # type: ignore[misc]
        factor = 3

    again: Any = cloudpickle.loads(cloudpickle.dumps(Derived))
    assert again.factor == 3 and issubclass(again, made)
    monkeypatch.setattr(sys.modules[__name__], "Derived", Derived, raising=False)
    Derived.__qualname__ = "Derived"
    assert pickle.loads(pickle.dumps(Derived)) is cloudpickle.loads(cloudpickle.dumps(Derived)) is Derived
