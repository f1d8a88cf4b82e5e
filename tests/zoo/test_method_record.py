"""The record that a run keeps of its method."""

import json
from pathlib import Path

import pytest
from torch import nn

from sb3_abisim.zoo.method_record import MethodRecord

# Of the records that were written before there were options.
KEYS = "method", "frozen", "encoder", "encoder_hash", "preprocessing"


def test_records(tmp_path: Path) -> None:
    assert MethodRecord.read(tmp_path) is None
    record = MethodRecord("ssi", True, "e", "0" * 64, {"frame_stack": 4, "env_wrapper": [nn.Module]})
    record.write(tmp_path)
    document = json.loads((tmp_path / "method.json").read_text())
    assert document["preprocessing"]["env_wrapper"] == [str(nn.Module)]
    read = MethodRecord.read(tmp_path)
    assert read is not None and (read.label, read.encoder_hash) == ("ssi,frozen", "0" * 64)
    assert MethodRecord("ssi", False, "e", None, {}).label == "ssi"
    assert MethodRecord(None, False, None, None, {}).label is None
    more = MethodRecord("ssi", True, "e", None, {}, 8, "random_crop", "ssi:weight=0")
    more.write(tmp_path)
    assert MethodRecord.read(tmp_path) == more
    assert more.label == "ssi,frozen,task_features_dim=8,augment=random_crop,auxiliary=ssi:weight=0"
    # As those of before are.
    (tmp_path / "method.json").write_text(json.dumps({key: document[key] for key in list(document) if key in KEYS}))
    before = MethodRecord.read(tmp_path)
    assert before is not None and before.label == "ssi,frozen"
    others = {"more": 1}, {"task_features_dim": "8"}, {"augment": 1}, {"auxiliary": 1}
    for text in ("{", "[]", "{}", *(json.dumps({**document, **other}) for other in others)):
        (tmp_path / "method.json").write_text(text)
        with pytest.raises(ValueError, match=r"method\.json is damaged .*leave the run out"):
            MethodRecord.read(tmp_path)
