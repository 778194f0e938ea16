"""Sweeps: many trajectories of one scene, block by block, into a store."""
