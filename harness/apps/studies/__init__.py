"""Studies: the paper's claims and their reproduction, tuning, the robustness map."""
