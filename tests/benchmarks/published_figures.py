"""The eyes of the published tables (Csoba & Kunkli 2023)."""

CONDITIONS = (
    "emmetropia",
    "myopia",
    "astigmatism",
    "keratoconus",
    "cataract",
    "post_lasik",
)
