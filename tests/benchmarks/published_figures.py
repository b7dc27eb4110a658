"""The eyes of the published tables (Csoba & Kunkli 2023), and their hardware."""

HARDWARE = "NVIDIA TITAN Xp"

CONDITIONS = (
    "emmetropia",
    "myopia",
    "astigmatism",
    "keratoconus",
    "cataract",
    "post_lasik",
)
