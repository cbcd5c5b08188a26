"""FMU models that servobench exports, a folder each, and the exporters."""
