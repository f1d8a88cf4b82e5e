"""What a benchmark compares, and with which budget."""

import dataclasses

import gymnasium as gym

from sb3_abisim.envs import ENV_IDS


@dataclasses.dataclass(frozen=True)
class Plan:
    """What to compare, and with which budget.

    :param methods: as ``--conf-file`` of ``sb3-abisim train`` takes them; without ``=ENCODER``, one is pretrained;
        ``{seed}`` in it becomes the seed of pretraining, for files of several
    :param env_ids: registered ids
    :param seeds: of RL, one run each
    :param encoder_seeds: of pretraining; the runs take the encoders in turn, so that five of each are paired
    :param algo: rl-zoo3's name; None takes that of each environment's traits
    :param n_transitions: random-action transitions per environment; None takes that of its traits
    :param n_timesteps: RL steps of a run; None for those of the environment's hyperparameters
    :param eval_freq: RL steps between evaluations; None for the paper's, but at least 100 evaluations in a run
    :param eval_episodes: of each evaluation during training
    :param n_eval_envs: evaluated side by side
    :param final_episodes: of the final model on each split and in each mode of acting; 0 for no final evaluation
    :param params: more of rl-zoo3's ``-params``, ``name:value``, or ``algo.name:value`` for one algorithm
    :param pretrain_params: settings of pretraining, ``name:value``, or ``objective.name:value`` for one objective
    :param device: of pretraining and RL
    :param threads: of each job
    :param packages: modules that register environments and methods, imported by each job
    :param image_key: which image of a ``Dict`` of observations is pretrained on; the runs see all of them. None for
        observations that are one image
    :raises ValueError: for what does not fit together
    """

    methods: tuple[str, ...]
    env_ids: tuple[str, ...]
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    encoder_seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    algo: str | None = None
    n_transitions: int | None = None
    n_timesteps: int | None = None
    eval_freq: int | None = None
    eval_episodes: int = 20
    n_eval_envs: int = 5
    final_episodes: int = 100
    params: tuple[str, ...] = ()
    pretrain_params: tuple[str, ...] = ()
    device: str = "auto"
    threads: int = 1
    packages: tuple[str, ...] = ()
    image_key: str | None = None

    def __post_init__(self) -> None:
        for name in ("methods", "env_ids", "seeds", "encoder_seeds"):
            values = getattr(self, name)
            if not values or len(set(values)) != len(values):
                raise ValueError(f"{name} must be given, and each once, got {' '.join(map(str, values)) or 'none'}")
        for name, least in (
            ("n_transitions", 1), ("n_timesteps", 1), ("eval_freq", 1), ("eval_episodes", 1), ("n_eval_envs", 1),
            ("final_episodes", 0), ("threads", 1),
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"{name} must be at least {least}, got {value}")
        for seed in (*self.seeds, *self.encoder_seeds):
            if seed < 0:
                raise ValueError(f"seeds must be at least 0, got {seed}")
        for env_id in self.env_ids:
            if env_id not in gym.registry:
                raise ValueError(
                    f"unknown environment {env_id!r}; ours are {', '.join(ENV_IDS)} (--packages imports what registers "
                    "others)"
                )
        for word in (*self.params, *self.pretrain_params):
            if not word.partition(":")[1]:
                raise ValueError(f"settings are given as name:value, got {word!r}")
