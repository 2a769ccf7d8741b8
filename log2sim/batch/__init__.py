"""Many logs at once: found below a folder, reconstructed by the workers of a Dask cluster, summed up in tables."""

from log2sim.batch.run import Batch, plan_batch, reconstruct_all, run_batch

__all__ = ["Batch", "plan_batch", "reconstruct_all", "run_batch"]
