"""Many runs: side by side, into one results folder."""
