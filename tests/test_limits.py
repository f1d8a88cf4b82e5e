"""docs/limits.md: each row of its table has tests, its numbers are those of the code, and each command is in it."""

import re
from pathlib import Path

import pytest

from sb3_abisim.__main__ import COMMANDS
from sb3_abisim.common import arrays, spaces, yaml_text
from sb3_abisim.data.readers import arrays as array_reader
from sb3_abisim.envs import base
from sb3_abisim.envs.backgrounds import video_frames
from sb3_abisim.envs.scan_nav import build, files
from sb3_abisim.networks import bounded, encoder_file
from sb3_abisim.zoo import named

ROOT = Path(__file__).resolve().parent
PAGE = (ROOT.parent / "docs" / "limits.md").read_text()
MILLION = 1_000_000
# Row: numbers as they stand in it, and the tests of what is read and refused.
ROWS: dict[str, tuple[dict[str, float], list[str]]] = {
    "arguments of environments": ({"4 GiB": base.MAX_BATCH_BYTES}, [
        "envs/test_base.py::test_arguments_of_a_wrong_type_are_refused_by_name",
        "envs/test_base.py::test_unknown_arguments_are_refused_by_name",
    ]),
    "actions and steps": ({}, ["envs/test_base.py::test_a_step_after_the_end_is_an_error"]),
    "observations": ({"33,554,432": spaces.MAX_SPACE_SIZE}, [
        "data/test_observations_declared.py::test_an_image_that_is_not_declared",
        "data/test_observations_declared.py::test_a_part_that_is_not_declared",
    ]),
    "rewards, observations, actions, losses, weights": ({}, [
        "zoo/test_folders.py::test_nan_rewards_end_a_run_of_dqn",
        "rl/test_callbacks.py::test_training_stops_at_a_number_that_is_none",
        "rl/test_callbacks.py::test_training_stops_at_an_action_that_is_none",
        "rl/test_callbacks.py::test_training_stops_at_a_loss_or_a_weight_that_is_none",
    ]),
    "scans": ({"8 million": files.MAX_FACES}, [
        "envs/scan_nav/test_gltf.py::test_what_is_not_known_to_be_read_right_is_refused",
        "envs/scan_nav/test_obj.py::test_what_is_not_known_to_be_read_right_is_refused",
        "envs/scan_nav/test_second_reader.py::test_faces_are_counted_before_they_are_copied",
    ]),
    "scan maps (`.npz`)": ({"256 MiB": arrays.MAX_BYTES, "16 million": build.MAX_PIXELS}, [
        "envs/scan_nav/test_map.py::test_refuses_wrong_maps_from_elsewhere",
        "envs/scan_nav/test_map.py::test_a_file_that_declares_more_than_a_map_is_refused_before_it_is_unpacked",
    ]),
    "videos": (
        {"17 million": video_frames.MAX_VIDEO_PIXELS, "10,000": video_frames._MAX_PIXELS_PER_BYTE,
         "2 billion": video_frames._MAX_PIXELS},
        ["envs/backgrounds/test_video_frames.py::test_frames_that_are_too_large_are_refused_before_they_are_decoded",
         "envs/backgrounds/test_video_frames.py::test_more_pixels_than_so_small_a_file_can_hold",
         "envs/backgrounds/test_video_frames.py::test_half_a_video"],
    ),
    "folders of frames": ({"34 million": video_frames.MAX_FRAME_PIXELS}, [
        "envs/backgrounds/test_video_frames.py::test_images_of_more_than_8_bits_are_refused",
        "envs/backgrounds/test_video_frames.py::test_missing_frames_of_a_folder",
    ]),
    "datasets": ({"33,554,432": spaces.MAX_SPACE_SIZE}, [
        "data/test_forged.py::test_a_dataset_with_any_value_in_any_place",
        "data/test_forged.py::test_spaces_are_bounded",
        "data/test_dataset_damage.py::test_a_pickle_in_place_of_an_array_is_not_run",
    ]),
    "arrays": ({"512 MiB": array_reader.MAX_UNPACKED_BYTES}, [
        "data/readers/test_arrays.py::test_what_a_header_declares_is_not_believed",
        "data/readers/test_arrays.py::test_what_an_archive_declares_is_not_believed",
    ]),
    "LeRobot and Minari folders": ({}, [
        "data/readers/test_lerobot.py::test_a_list_of_files_in_place_of_a_video_is_refused",
        "data/readers/test_lerobot.py::test_a_folder_with_the_name_of_an_address_is_a_folder",
        "data/readers/test_lerobot.py::test_an_info_that_does_not_fit",
    ]),
    "encoder files": ({"1 GiB": encoder_file.MAX_FILE_BYTES}, [
        "networks/test_encoder_file.py::test_a_file_of_the_largest_size_is_read",
        "networks/test_encoder_file_forged.py::test_a_network_that_is_not_registered_is_refused",
        "data/test_forged.py::test_networks_larger_than_their_file",
    ]),
    "checkpoints of pretraining": ({}, [
        "pretraining/test_checkpoint.py::test_a_forged_checkpoint_is_one_sentence",
        "pretraining/test_checkpoint.py::test_a_file_of_something_else_with_a_right_hash",
    ]),
    "zips of Stable-Baselines3": ({"16": bounded._N_COPIES, "64 MiB": bounded._ROOM_BYTES}, [
        "zoo/test_models.py::test_no_command_executes_a_model",
        "zoo/test_models.py::test_weights_are_bounded_by_the_zip",
        "zoo/test_models.py::test_a_zip_outside_of_a_run",
        "zoo/test_continue.py::test_what_is_refused",
    ]),
    "`vecnormalize.pkl`": ({}, [
        "zoo/test_normalized.py::test_means_that_are_not_those_of_the_run",
        "zoo/test_guard.py::test_nothing_is_executed",
    ]),
    "YAML of runs (`config.yml`, `args.yml`)": (
        {"256 KiB": yaml_text.MAX_BYTES, "50,000": yaml_text.MAX_NODES, "10,000": named._MAX_TEXT},
        ["common/test_yaml_text.py::test_refusals_name_the_file",
         "zoo/test_models.py::test_a_configuration_executes_and_imports_nothing"],
    ),
    "results of runs (`*.npz`, `*.monitor.csv`, `method.json`)": ({"256 MiB": arrays.MAX_BYTES}, [
        "zoo/test_run_damage.py::test_what_a_damaged_file_is_called",
        "common/test_arrays.py::test_bombs_and_absent_files",
    ]),
    "pickles of `zoo all_plots`": ({}, ["zoo/test_guard.py::test_a_pickle_of_curves_needs_trust"]),
    "`benchmark.json`": ({}, ["zoo/test_run_damage.py::test_what_a_damaged_file_is_called"]),
    "disks, folders and outputs": ({}, [
        "common/test_files.py::test_full_disk_is_found_out_before_writing",
        "data/test_collect.py::test_full_disk_is_one_message_and_resumes",
        "zoo/test_folders.py::test_merge_keeps_the_old_file_on_a_full_disk",
        "zoo/test_whole_files.py::test_train_keeps_what_it_saved_before_the_disk_was_full",
        "test_faults.py::test_what_may_not_be_read",
        "test_faults.py::test_an_output_that_cannot_be",
        "test_faults.py::test_a_full_disk",
    ]),
}  # fmt: skip
_UNITS = {"KiB": 2**10, "MiB": 2**20, "GiB": 2**30, "million": MILLION, "billion": 1000 * MILLION}


def rows() -> dict[str, str]:
    table = PAGE[: PAGE.index("## Counted")]
    lines = [line for line in table.splitlines() if line.startswith("| ")][1:]
    return {line.split(" | ")[1]: line for line in lines}


def test_every_row_is_known() -> None:
    assert list(rows()) == list(ROWS)


def test_every_command_is_in_the_table() -> None:
    words = re.findall(r"`(\w+)", " ".join(line.split(" | ")[0] for line in rows().values()))
    assert set(words) == set(COMMANDS)


@pytest.mark.parametrize("row", ROWS)
def test_numbers_are_those_of_the_code_and_tests_are_there(row: str) -> None:
    numbers, tests = ROWS[row]
    for text, value in numbers.items():
        number, _, unit = text.partition(" ")
        assert int(number.replace(",", "")) * _UNITS.get(unit, 1) == value and text in rows()[row]
    assert tests
    for test in tests:
        path, name = test.split("::")
        assert re.search(rf"def {name}\(", (ROOT / path).read_text()), test
