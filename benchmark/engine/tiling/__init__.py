"""Maps in tiles: what each frame sees of them, who fuses which, and how the parts become a unit again."""
