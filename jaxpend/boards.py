"""The published v2 boards of RealAIGym: their rows, and what their columns are called."""

__all__ = ["HEADINGS", "PUBLISHED"]

# Performance and robustness, as published (arXiv 2409.08938 and the boards).
PUBLISHED = {
    "acrobot": {
        "Evolutionary SAC": (0.524, 0.692),
        "HistorySAC": (0.655, 0.751),
        "AR-EAPO": (0.633, 0.727),
        "TVLQR": (0.504, 0.607),
        "iLQR MPC": (0.345, 0.343),
        "iLQR Riccati gains": (0.396, 0.138),
    },
    "pendubot": {
        "Evolutionary SAC": (0.596, 0.796),
        "HistorySAC": (0.682, 0.770),
        "AR-EAPO": (0.659, 0.913),
        "TVLQR": (0.526, 0.767),
        "iLQR MPC": (0.353, 0.674),
        "iLQR Riccati gains": (0.536, 0.255),
    },
}
# The criteria of the performance score: heading, unit and format.
HEADINGS = {
    "swingup_time": ("swing-up", "s", ".2f"),
    "energy": ("energy", "J", ".2f"),
    "tau_cost": ("torque cost", "N²m²s", ".2f"),
    "tau_smoothness": ("smoothness", "N m", ".4f"),
    "velocity_cost": ("velocity cost", "rad²/s", ".1f"),
}
