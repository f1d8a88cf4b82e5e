"""Methods x environments x seeds as zoo runs, here or on a cluster, and the report on them.

``sb3-abisim benchmark`` is the command (:mod:`sb3_abisim.benchmark.command`). The parts, in the order of the
data: ``graph`` names the jobs, ``job`` runs one, ``engine`` and ``ray_engine`` run many, ``evaluate`` holds a final
model against the distractors, ``runs`` reads run folders, ``statistics`` and ``report`` say what they show.
"""
