"""How XLA compiles large programs for a CPU."""

ON_CPU = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}
"""Compiler options. XLA's fusion emitters compute the pose of a link anew wherever MJX uses it, for each link of
a chain again: inverse dynamics of 100 states takes 0.5 ms with 3 joints, 0.5 s with 7 and 6 s with 9; without
them 0.4 to 1 ms (`experiments/speed/mjx_on_cpu.py`). The solver of the retrieval compiles in a third of the time
so, and runs as fast."""
