"""Studies: challenges with their scores, and the robustness map."""
