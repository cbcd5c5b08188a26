"""One run: request, reference, task, loop, log and metrics."""
