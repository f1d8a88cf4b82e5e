"""rl-zoo3 imports this file from the folder in which one of its commands starts."""

try:
    import sb3_abisim.zoo  # noqa: F401  (registers the environments and our hyperparameters)
except ImportError as error:
    # rl-zoo3 swallows an ImportError here and would only say that the environment is unknown.
    raise RuntimeError(f"sb3_abisim cannot be imported ({error}); install it with: pip install -e .") from error
