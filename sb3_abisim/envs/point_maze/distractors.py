"""PointMaze with a moving background."""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.backgrounds.clips import SPLITS, Backgrounds
from sb3_abisim.envs.backgrounds.load import load_backgrounds
from sb3_abisim.envs.backgrounds.player import N_SAMPLES, BackgroundPlayer
from sb3_abisim.envs.base import SingleEnv
from sb3_abisim.envs.point_maze.env import PointMazeVectorEnv


class DistractorPointMazeVectorEnv(PointMazeVectorEnv):
    """``num_envs`` point mazes whose floor shows a video clip.

    World, actions, physics and reward are those of :class:`~sb3_abisim.envs.point_maze.env.PointMazeVectorEnv`.

    **Observation.** uint8 (3, 64, 64), RGB. Every pixel that agent, goal, obstacles or walls touch has the bytes of the
    plain PointMaze; every other pixel shows the background. An episode has one clip, sampled uniformly from the split,
    and a start sampled uniformly from its frames. Each step shows the next frame; at its ends the clip reverses.

    **Splits.** "train" and "eval" share no video and no photograph: pretrain and train on the one, evaluate on the
    other. "clean" shows the plain floor, for a comparison. The same seed gives the same mazes in all three.

    **Color jitter.** In "train" each episode shows its clip mirrored and in other colors
    (:class:`~sb3_abisim.envs.backgrounds.color_jitter.ColorJitter`), unless ``color_jitter`` is False. "eval" shows
    clips as they are.

    **Factors.** Those of PointMaze, and ``clip``, the index of the clip in the split, ``clip_id``, a number that stands
    for its content in any split, and ``frame``, the index of the frame shown; int64, each -1 in the split "clean".

    :param num_envs: number of copies, at least 1
    :param videos: folder of custom videos, see docs/distractors.md; None for the built-in clips ``photo_pan``
    :param split: "train", "eval" or "clean"
    :param order: "video", or "shuffled" for the frames of a clip in an order sampled for each episode, so that
        neighboring frames are not alike
    :param clips: names of the clips to show; None for all of the split
    :param color_jitter: whether "train" shows clips with a color jitter sampled for each episode; of no effect in the
        other splits
    :param video_kwargs: further arguments of :func:`~sb3_abisim.envs.backgrounds.load.load_backgrounds`
    :param kwargs: arguments of PointMaze
    :raises ValueError: for unknown settings, and for what is wrong with the videos
    :raises ImportError: if custom videos are given and a decoder is not installed
    """

    def __init__(
        self,
        num_envs: int = 1,
        videos: str | os.PathLike[str] | None = None,
        split: str = "train",
        order: str = "video",
        clips: Sequence[str] | None = None,
        color_jitter: bool = True,
        video_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        if split not in (*SPLITS, "clean"):
            raise ValueError(f"split must be 'train', 'eval' or 'clean', got {split!r}")
        if split == "clean" and (videos is not None or clips is not None or video_kwargs):
            raise ValueError("split='clean' shows no clips; leave out videos, clips and video_kwargs")
        if videos is None and video_kwargs:
            raise ValueError(f"video_kwargs={video_kwargs} applies to custom videos only; give videos= or leave it out")
        super().__init__(num_envs, **kwargs)
        self._player: BackgroundPlayer | None = None
        if split != "clean":
            backgrounds = load_backgrounds(videos, split, **(video_kwargs or {}))
            if clips is not None:
                backgrounds = backgrounds.select(clips)
            self._player = BackgroundPlayer(backgrounds, num_envs, order, color_jitter and split == "train")

    @property
    def backgrounds(self) -> Backgrounds | None:
        """The clips that can be shown; None in the split "clean"."""
        return None if self._player is None else self._player.backgrounds

    @property
    def content_hash(self) -> str:
        """sha256 over the clips that can be shown and whether with color jitter, "clean" where there are none."""
        return "clean" if self._player is None else self._player.content_hash

    def _reset_envs(self, indices: NDArray[np.int64]) -> None:
        super()._reset_envs(indices)
        for i in indices.tolist():
            if self._player is None:
                self._generators[i].random(N_SAMPLES)  # so that the mazes that follow are those of the other splits
            else:
                self._player.start(i, self._generators[i])

    def _advance(self, actions: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        if self._player is not None:
            self._player.advance()
        return super()._advance(actions)

    def _observe(self, indices: NDArray[np.int64]) -> NDArray[np.uint8]:
        if self._player is None:
            return super()._observe(indices)
        return self._observe_over(self._player.frames(indices), indices)

    def _backdrop(self, index: int) -> NDArray[np.uint8]:
        layer: NDArray[np.uint8] = super()._backdrop(index)
        if self._player is None:
            return layer
        backgrounds = self._player.frames(np.array([index]))
        self._lay_over(backgrounds, np.array([index]))
        backdrop: NDArray[np.uint8] = backgrounds[0]
        return backdrop

    def factors(self) -> dict[str, NDArray[Any]]:
        """The simulator's state that the current observations show, for probes; see the class."""
        absent = np.full(self.num_envs, -1, dtype=np.int64)
        clip, clip_id, frame = absent, absent.copy(), absent.copy()
        if self._player is not None:
            clip, frame = self._player.clip.copy(), self._player.frame_index
            clip_id = self._player.backgrounds.clip_ids[clip]
        return super().factors() | {"clip": clip, "clip_id": clip_id, "frame": frame}


class DistractorPointMazeEnv(SingleEnv):
    """One :class:`DistractorPointMazeVectorEnv`, as a ``gymnasium.Env``; the specification stands there."""

    batch_class = DistractorPointMazeVectorEnv

    @property
    def content_hash(self) -> str:
        """sha256 over the clips that can be shown, "clean" where there are none."""
        content_hash: str = self.batch.content_hash  # type: ignore[attr-defined]
        return content_hash
