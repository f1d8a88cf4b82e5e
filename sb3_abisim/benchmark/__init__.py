"""Methods x environments x seeds as zoo runs, here or on a cluster, and the report on them.

``sb3-abisim benchmark`` is the command (:mod:`sb3_abisim.benchmark.command`). The parts, in the order of the data:
``plan`` says what to compare, ``graph`` makes its jobs, ``jobs`` runs them here or on a cluster, ``report`` reads the
run folders and compares them, ``export`` copies what the report reads, ``sweep`` searches settings of pretraining.
"""
