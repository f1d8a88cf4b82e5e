"""Trains one encoder of a policy by an objective: optimizer, base, random numbers, and all of it as a state.

An objective that builds on a base, as ``abisim`` does on ``ssi``, gets one that learns beside it, by its own loss. As
in pretraining, no gradient leads from one to the other: the objective sees a copy of the base that follows it.
"""

import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from sb3_abisim.common.transitions import TransitionBatch
from sb3_abisim.networks.base import Encoder, make_encoder, preprocess, set_memory_format
from sb3_abisim.objectives.base import Objective, TensorBatch
from sb3_abisim.registry import get_method, get_objective
from sb3_abisim.rl.auxiliary_data import Steps, sample_batch, sample_observations
from sb3_abisim.rl.auxiliary_state import pack, unpack
from sb3_abisim.rl.extractors import BaseEncoderExtractor

# For objectives that look at observations from all over the data first.
N_PREPARE = 512
# Updates between two times at which they look at the same ones again, where the base has changed meanwhile.
PREPARE_INTERVAL = 50
_ENCODER = "encoder."
_BASE = "base_objective."


@dataclass(frozen=True)
class AuxiliarySettings:
    """What :class:`~sb3_abisim.rl.auxiliary.AuxiliaryObjective` was given, with what follows from the environment.

    :param objective: name of a method that has one
    :param weight: the encoder's learning rate divided by that of the heads
    :param learning_rate: of Adam
    :param batch_size: transitions per update
    :param k: steps between the two observations, or the fewest and the most of them
    :param seed: of heads and batches
    :param objective_kwargs: arguments of the objective
    :param base_kwargs: arguments of the base's objective
    """

    objective: str
    weight: float
    learning_rate: float
    batch_size: int
    k: int | list[int]
    seed: int
    objective_kwargs: dict[str, Any] = field(default_factory=dict)
    base_kwargs: dict[str, Any] = field(default_factory=dict)

    def shape(self) -> dict[str, Any]:
        """What a state must agree with."""
        return {
            "objective": self.objective, "k": self.k,
            "objective_kwargs": self.objective_kwargs, "base_kwargs": self.base_kwargs,
        }  # fmt: skip


class OwnRandomness:
    """A stream of torch's random numbers that leaves the global one as it is.

    :param seed: of the stream
    :param device: of the model
    """

    def __init__(self, seed: int, device: th.device) -> None:
        self._devices = [device] if device.type == "cuda" else []
        self.state = th.Generator().manual_seed(seed).get_state()

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        """Within it, torch's global random numbers are those of this stream."""
        with th.random.fork_rng(devices=self._devices):
            th.set_rng_state(self.state)
            if self._devices:
                # Objectives sample on the CPU; layers such as dropout do not.
                th.cuda.manual_seed(int(th.randint(2**31, ())))
            yield
            self.state = th.get_rng_state()


class AuxiliaryTrainer:
    """Goes on training the encoder of one extractor.

    :param extractor: whose encoder is trained; its state, where a saved model brought one, is taken up
    :param action_space: of the environment
    :param settings: what to train by
    :param key: of the extractor's image in a ``Dict``, None for observations that are one image
    :param index: number of the extractor in the policy: each has random numbers of its own
    :raises ValueError: for settings that do not fit the objective, or a state of other settings
    """

    def __init__(
        self,
        extractor: BaseEncoderExtractor,
        action_space: gym.Space[Any],
        settings: AuxiliarySettings,
        key: str | None = None,
        index: int = 0,
    ) -> None:
        self.extractor, self.settings, self.key = extractor, settings, key
        self._encoder: Encoder = extractor.encoder
        self._space = extractor._observation_space
        self._device = extractor.initial_weights.device
        seeds = np.random.SeedSequence([settings.seed, index]).generate_state(2).tolist()
        self._randomness = OwnRandomness(seeds[0], self._device)
        self._generator = np.random.Generator(np.random.PCG64(seeds[1]))
        with self._randomness():
            self._base, self.objective = self._make(action_space)
        self._needs_preparation = type(self.objective).prepare is not Objective.prepare
        # What the objective has looked at, and the random numbers that it did so with.
        self._looked_at: NDArray[np.uint8] | None = None
        self._looked_with = self._randomness.state
        self._trained = self._name_trained()
        encoder = [p for name, p in self._trained.items() if name.startswith(_ENCODER)]
        heads = [p for name, p in self._trained.items() if not name.startswith(_ENCODER)]
        groups: list[dict[str, Any]] = [
            {"params": heads}, {"params": encoder, "lr": settings.weight * settings.learning_rate},
        ]  # fmt: skip
        self._optimizer = th.optim.Adam([group for group in groups if group["params"]], lr=settings.learning_rate)
        self.n_updates = 0
        # Further numbers and tensors that belong to the state, by name; `keep_later` makes tensors when they are saved.
        self.extra: dict[str, Any] = {}
        self.extra_tensors: dict[str, th.Tensor] = {}
        self._extra_fn: Callable[[], dict[str, th.Tensor]] = lambda: self.extra_tensors
        self._packed: th.Tensor | None = None
        self.attach()

    def _make(self, action_space: gym.Space[Any]) -> tuple[Objective | None, Objective]:
        settings = self.settings
        objective_class: type[Objective] = get_objective(settings.objective)
        objective_class.check_k(settings.k)
        kwargs = dict(settings.objective_kwargs)
        base_method, base = get_method(settings.objective).base, None
        if base_method is not None:
            base_class: type[Objective] = get_objective(base_method)
            base_class.check_k(settings.k)
            if get_method(base_method).base is not None or base_class.prepare is not Objective.prepare:
                raise ValueError(
                    f"the base of {settings.objective!r}, {base_method!r}, cannot be trained while RL runs; pretrain, "
                    "and give the file to the features extractor"
                )
            base_encoder = make_base_encoder(self._encoder, self._space, objective_class)
            base = build_objective(base_class, base_encoder, action_space, dict(settings.base_kwargs), settings.k)
            kwargs["base_encoder"] = base_encoder
        elif settings.base_kwargs:
            raise ValueError(f"{settings.objective!r} builds on no base, got base_kwargs={settings.base_kwargs}")
        objective = build_objective(objective_class, self._encoder, action_space, kwargs, settings.k)
        if base is not None and not isinstance(getattr(objective, "base_encoder", None), Encoder):
            raise ValueError(
                f"{settings.objective!r} keeps no base_encoder, which has to follow the base that learns beside "
                "it; let the objective keep a frozen copy as self.base_encoder"
            )
        for module in (base, objective):
            if module is not None:
                # Leaves the encoder as it is: it is there already.
                set_memory_format(module.to(self._device), th.channels_last)
        return base, objective

    def _name_trained(self) -> dict[str, nn.Parameter]:
        """Everything that is trained, each once; not the encoder, if its weight is 0."""
        named = {f"{_BASE}{n}": p for n, p in self._base.named_parameters()} if self._base is not None else {}
        named |= dict(self.objective.named_parameters())
        with_encoder = self.settings.weight > 0
        return {n: p for n, p in named.items() if p.requires_grad and (with_encoder or not n.startswith(_ENCODER))}

    def update(self, steps: Steps) -> dict[str, th.Tensor] | None:
        """One update on transitions of the algorithm; None while there are too few.

        :param steps: to sample from
        :return: the named terms
        :raises FloatingPointError: if a number is not finite
        """
        if not self._prepare(steps):
            return None
        batch = sample_batch(
            steps, self._generator, self.settings.batch_size, self.settings.k,
            self.objective.reads_action_sequences, self.key,
        )  # fmt: skip
        if batch is None:
            return None
        with self._randomness(), self._training_mode():
            terms = self._step(self._to_tensors(batch))
        self.n_updates += 1
        self._packed = None
        return terms

    def _step(self, batch: TensorBatch) -> dict[str, th.Tensor]:
        loss, terms = self.objective.loss(batch)
        if self._base is not None:
            base_loss, base_terms = self._base.loss(batch)
            loss = loss + base_loss
            terms |= {f"base_{name}": term for name, term in base_terms.items()}
        parameters = list(self._trained.values())
        # Not loss.backward(): it would leave gradients with what is not trained here.
        gradients = th.autograd.grad(loss, parameters, allow_unused=True) if loss.requires_grad else [None]
        there = [gradient for gradient in gradients if gradient is not None]
        self._require_finite({**terms, "loss": loss, "gradient norm": th.nn.utils.get_total_norm(there)})
        # RL's gradients stay where they are.
        theirs = [parameter.grad for parameter in parameters]
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        self._optimizer.step()
        for parameter, gradient in zip(parameters, theirs, strict=True):
            parameter.grad = gradient
        self.objective.after_step()
        if self._base is not None:
            self._base.after_step()
            follow(self._base.encoder, self.objective.base_encoder)  # type: ignore[arg-type]
        return {"loss": loss.detach(), **terms}

    def _require_finite(self, values: dict[str, th.Tensor]) -> None:
        for name, value in values.items():
            if not bool(th.isfinite(value)):
                raise FloatingPointError(
                    f"the auxiliary objective {self.settings.objective} has {name} = {float(value.detach())} at its "
                    f"update {self.n_updates}, and training stops; lower its learning_rate "
                    f"({self.settings.learning_rate:g}) or its weight ({self.settings.weight:g})"
                )

    def _prepare(self, steps: Steps) -> bool:
        """Let the objective look at observations from all over the data; False while there are too few."""
        if not self._needs_preparation:
            return True
        again = self._looked_at is not None
        if again and (self._base is None or self.n_updates % PREPARE_INTERVAL):
            return True
        if not again:
            self._looked_at = sample_observations(steps, self._generator, N_PREPARE, self.key)
            self._looked_with = self._randomness.state
        if self._looked_at is None:
            return False
        frames = th.as_tensor(self._looked_at).to(self._device)
        later = self._randomness.state
        # The same random numbers at each time: of the same observations, the same ones are chosen.
        self._randomness.state = self._looked_with
        with self._randomness(), self._training_mode():
            self.objective.prepare(preprocess(frames, self._space))
        self._randomness.state = later if again else self._randomness.state
        self._packed = None
        return True

    @contextlib.contextmanager
    def _training_mode(self) -> Iterator[None]:
        """As in pretraining; an encoder that is not trained stays in the mode that RL has put it in."""
        modes = [(module, module.training) for module in self._encoder.modules()]
        for part in (self._base, self.objective):
            if part is not None:
                part.train()
        if not self.settings.weight > 0:
            self._encoder.eval()
        try:
            yield
        finally:
            for module, mode in modes:
                module.training = mode

    def _to_tensors(self, batch: TransitionBatch[Any]) -> TensorBatch:
        """Through Stable-Baselines3's preprocessing, so that the encoder sees what it sees in RL."""
        frames = th.as_tensor(batch.frames).contiguous(memory_format=th.channels_last).to(self._device)
        actions = th.as_tensor(batch.actions).to(self._device)
        return TensorBatch(preprocess(frames, self._space), actions, batch.obs_index, batch.next_obs_index)

    def attach(self) -> None:
        """Take up a state that a loaded model has brought, and save the present one with the model from now on.

        :raises ValueError: for a state of other settings
        """
        slot = self.extractor.auxiliary
        if slot.saver == self._pack:
            return
        packed = slot.packed()
        if packed is not None:
            self._restore(packed)
        slot.saver = self._pack

    def _pack(self) -> th.Tensor:
        if self._packed is None:
            # Aliases of an extractor in the state dict then share memory, which torch.save keeps.
            self._packed = pack(self._tensors(), self._numbers())
        return self._packed

    def keep_later(self, extra_fn: Callable[[], dict[str, th.Tensor]]) -> None:
        """Have further tensors saved, which are made when that happens; ``extra`` may have changed.

        :param extra_fn: gives them by name
        """
        self._extra_fn, self._packed = extra_fn, None

    def _tensors(self) -> dict[str, th.Tensor]:
        tensors = {f"module.{name}": tensor for name, tensor in self._modules_state().items()}
        for name, parameter in self._trained.items():
            for key, value in self._optimizer.state.get(parameter, {}).items():
                tensors[f"adam.{key}.{name}"] = th.as_tensor(value)
        tensors["rng"] = self._randomness.state
        if self._looked_at is not None:
            tensors |= {"looked_at": th.from_numpy(self._looked_at), "looked_with": self._looked_with}
        return tensors | {f"extra.{name}": tensor for name, tensor in self._extra_fn().items()}

    def _numbers(self) -> dict[str, Any]:
        return {
            "settings": self.settings.shape(), "n_updates": self.n_updates, "extra": self.extra,
            "generator": self._generator.bit_generator.state,
        }  # fmt: skip

    def _modules_state(self) -> dict[str, th.Tensor]:
        """The state of objective and base, without that of the encoder, which the extractor saves."""
        own = {name: t for name, t in self.objective.state_dict().items() if not name.startswith(_ENCODER)}
        return own if self._base is None else own | {f"{_BASE}{n}": t for n, t in self._base.state_dict().items()}

    def _restore(self, packed: th.Tensor) -> None:
        tensors, numbers = unpack(packed)
        here, there = self.settings.shape(), numbers["settings"]
        # Through JSON, tuples have become lists.
        if differing := [name for name in here if _listed(here[name]) != there.get(name)]:
            sides = "; ".join(f"{n}: {there.get(n)!r} there, {here[n]!r} here" for n in differing)
            raise ValueError(
                f"the model was trained with another auxiliary objective ({sides}); go on with the same one, or "
                "begin with a new model"
            )
        state = {name.removeprefix("module."): t for name, t in tensors.items() if name.startswith("module.")}
        with th.no_grad():
            for name, tensor in self._modules_state().items():
                tensor.copy_(state[name])
        for name, tensor in tensors.items():
            kind, _, rest = name.partition(".")
            if kind == "adam":
                key, _, parameter = rest.partition(".")
                if parameter in self._trained:
                    # Adam keeps its count of steps on the CPU.
                    value = tensor if key == "step" else th.empty_like(self._trained[parameter]).copy_(tensor)
                    self._optimizer.state[self._trained[parameter]][key] = value
            elif kind == "extra":
                self.extra_tensors[rest] = tensor
        self._randomness.state = tensors["rng"]
        if "looked_at" in tensors:
            self._looked_at, self._looked_with = tensors["looked_at"].numpy(), tensors["looked_with"]
        self._generator.bit_generator.state = numbers["generator"]
        self.n_updates, self.extra, self._packed = numbers["n_updates"], numbers["extra"], packed


def build_objective(
    objective_class: type[Objective],
    encoder: Encoder,
    action_space: gym.Space[Any],
    kwargs: dict[str, Any],
    k: int | list[int],
) -> Objective:
    """An objective around an encoder.

    :param objective_class: of a method
    :param encoder: to train
    :param action_space: of the environment
    :param kwargs: arguments of the objective
    :param k: steps between the two observations
    :raises ValueError: for arguments that do not fit
    """
    if objective_class.reads_action_sequences:
        kwargs["k"] = k
    try:
        return objective_class(encoder, action_space, **kwargs)
    except TypeError as error:
        raise ValueError(f"objective_kwargs do not fit {objective_class.name}: {error}") from error


def make_base_encoder(encoder: Encoder, space: gym.Space[Any], objective_class: type[Objective]) -> Encoder:
    """A base that begins with the weights of the encoder, in all layers that both have.

    :param encoder: of the policy; frozen or not
    :param space: of one observation
    :param objective_class: whose base it is
    """
    spec = encoder.spec()
    base = make_encoder(space, spec["name"], **objective_class.base_network_kwargs(spec["kwargs"]))
    if base.spec() == spec:
        base.load_state_dict(encoder.state_dict())
    else:
        base.warm_start(encoder)
    return base


@th.no_grad()
def follow(source: nn.Module, target: nn.Module) -> None:
    """Copy all weights and buffers.

    :param source: a module
    :param target: one of the same shape
    """
    new = source.state_dict()
    for name, tensor in target.state_dict().items():
        tensor.copy_(new[name])


def _listed(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _listed(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_listed(part) for part in value]
    return value if not isinstance(value, float) or math.isfinite(value) else str(value)
