"""Environments that others wrote: a PettingZoo ParallelEnv as a scenario."""
