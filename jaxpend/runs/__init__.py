"""Run folders: what training writes into them, and what reads them without jax."""
