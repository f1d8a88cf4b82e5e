"""Frozen weights are buffers: the same state dict, out of reach of whatever updates parameters."""

from torch import nn


def parameters_to_buffers(module: nn.Module) -> None:
    """Turn parameters into buffers: the same state dict, out of reach of whatever updates parameters."""
    for submodule in module.modules():
        for name, parameter in list(submodule.named_parameters(recurse=False)):
            delattr(submodule, name)
            submodule.register_buffer(name, parameter.detach().clone())


def buffers_to_parameters(module: nn.Module, names: list[str]) -> list[nn.Parameter]:
    """The inverse, for weights of these names."""
    parameters = []
    for name in names:
        path, _, attribute = name.rpartition(".")
        submodule = module.get_submodule(path)
        weights = submodule.get_buffer(attribute)
        delattr(submodule, attribute)
        parameters.append(nn.Parameter(weights.clone()))
        submodule.register_parameter(attribute, parameters[-1])
    return parameters
