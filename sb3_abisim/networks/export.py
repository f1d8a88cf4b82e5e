"""Encoders out of this package: ONNX and ``torch.export`` programs that take observations as environments give them.

``sb3-abisim export FILE -o encoder.onnx|encoder.pt2``

What is written maps uint8 observations to embeddings: SB3's division by 255 and the network's own map are part of it.
"""

import argparse
import io
import logging
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_abisim.common.cli import make_parser, run
from sb3_abisim.common.extras import require_extra
from sb3_abisim.common.files import check_output, write_atomic

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from torch import nn

    from sb3_abisim.networks.encoder_file import EncoderFile

INPUT, OUTPUT = "observations", "embeddings"
# Modules beside PyTorch that a kind of file needs.
_NEEDED: dict[str, tuple[str, ...]] = {".onnx": ("onnx", "onnxruntime", "onnxscript"), ".pt2": ()}


def export_encoder(name: str | Path, output: str | Path) -> "EncoderFile":
    """Write an encoder as a program that runs without this package, and check it on the file's reference batch.

    The program takes a batch of any size: uint8 (batch, channels, height, width), as in the encoder's observation
    space, and gives float32 (batch, features_dim).

    :param name: path of an encoder file, or name, as for ``load_encoder``
    :param output: a path that ends in ``.onnx`` or ``.pt2`` (``torch.export.save``)
    :return: the encoder file
    :raises ValueError: for another ending, or if the program does not give the reference batch's embeddings
    :raises ImportError: if the packages for ONNX are not installed
    """
    from sb3_abisim.networks.encoder_file import load_encoder, reference_batch

    output = Path(output)
    if output.suffix not in _NEEDED:
        raise ValueError(f"the output must end in .onnx or .pt2, got {str(output)!r}")
    require_extra("export", f"a file {output.suffix}", *_NEEDED[output.suffix])
    check_output(output)
    file = load_encoder(name)
    observations, expected = reference_batch(file)
    write, execute = _to_onnx if output.suffix == ".onnx" else _to_program
    data = write(_with_preprocessing(file), observations)
    # Also one by one, as an agent sees them.
    for part in (slice(None), slice(0, 1)):
        _check(output, execute(data, observations[part]), expected[part])
    output.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(output, lambda stream: stream.write(data))
    return file


def _with_preprocessing(file: "EncoderFile") -> "nn.Module":
    """The encoder with SB3's preprocessing in front."""
    import torch as th

    from sb3_abisim.networks.base import set_memory_format

    class FromBytes(th.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.encoder = file.encoder

        def forward(self, observations: th.Tensor) -> th.Tensor:
            embeddings: th.Tensor = self.encoder(observations.float() / 255.0)
            return embeddings

    # Weights with channels last are written with a warning.
    set_memory_format(file.encoder, th.contiguous_format)
    return FromBytes().eval()


def _program(module: "nn.Module", observations: "NDArray[np.uint8]") -> Any:
    import torch as th

    # An example of one observation would fix the size of the batch.
    example = th.as_tensor(observations).repeat(2, 1, 1, 1)
    return th.export.export(module, (example,), dynamic_shapes={INPUT: {0: th.export.Dim("batch", min=1)}})


def _write_program(module: "nn.Module", observations: "NDArray[np.uint8]") -> bytes:
    import torch as th

    stream = io.BytesIO()
    th.export.save(_program(module, observations), stream)
    return stream.getvalue()


def _run_program(data: bytes, observations: "NDArray[np.uint8]") -> "NDArray[np.float32]":
    import torch as th

    with th.no_grad():
        embeddings: NDArray[np.float32] = th.export.load(io.BytesIO(data)).module()(th.as_tensor(observations)).numpy()
    return embeddings


def _write_onnx(module: "nn.Module", observations: "NDArray[np.uint8]") -> bytes:
    import torch as th

    with warnings.catch_warnings():
        # PyTorch's own, about its present exporter.
        warnings.simplefilter("ignore")
        program: Any = th.onnx.export(
            _program(module, observations),
            input_names=[INPUT],
            output_names=[OUTPUT],
            dynamo=True,
            optimize=True,
            verbose=False,
        )
    data: bytes = program.model_proto.SerializeToString()
    return data


def _run_onnx(data: bytes, observations: "NDArray[np.uint8]") -> "NDArray[np.float32]":
    import onnxruntime  # type: ignore[import-untyped, import-not-found, unused-ignore]

    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    embeddings: NDArray[np.float32] = session.run([OUTPUT], {INPUT: observations})[0]
    return embeddings


_to_program = (_write_program, _run_program)
_to_onnx = (_write_onnx, _run_onnx)


def _check(output: Path, embeddings: "NDArray[np.float32]", expected: "NDArray[np.float32]") -> None:
    import numpy as np

    from sb3_abisim.networks.encoder_file import REFERENCE_TOLERANCE

    largest = float(np.abs(expected).max())
    difference = float(np.abs(embeddings - expected).max()) if embeddings.shape == expected.shape else np.inf
    if not difference <= REFERENCE_TOLERANCE * largest:
        raise ValueError(
            f"{output} was not written: the exported network's embeddings of the reference batch differ by up to "
            f"{difference:.3g} from those in the encoder file, whose largest is {largest:.3g}; try the other format"
        )


def main(argv: Sequence[str] | None = None) -> None:
    """The command; see ``--help``.

    :param argv: its arguments; None for those of the process
    """
    parser = make_parser(
        "export",
        "Write an encoder as a program that runs without this package: uint8 observations to embeddings, checked on "
        "the encoder file's reference batch.",
        "export PointMaze-v0/abisim -o encoder.onnx",
    )
    parser.add_argument("encoder", metavar="FILE", help="encoder file, or name of a shipped one")
    parser.add_argument(
        "-o", "--output", required=True, metavar="OUT", help="ends in .onnx (ONNX) or .pt2 (torch.export)"
    )
    run(parser, argv, _command)


def _command(args: argparse.Namespace) -> None:
    # PyTorch's exporter tells at each start that torchvision is not installed, which nothing here needs.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    file = export_encoder(args.encoder, args.output)
    shape = ", ".join(map(str, file.metadata["observation_space"]["shape"]))
    print(
        f"{args.output}: uint8 (batch, {shape}) to float32 (batch, {file.encoder.features_dim}), checked on the "
        f"reference batch of {file.path}"
    )
