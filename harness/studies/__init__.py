"""Studies: the paper's claims, tuning, the robustness map, the README's pictures."""
