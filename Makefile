# What a newcomer needs; everything else is cargo.

.PHONY: demo test stress

# Trains on a small dark set of our own making and leaves demo/index.html.
demo: vulkan
	cargo run --release -- demo --out demo

# Every test, on whatever Vulkan device is best; a software device will do.
test: vulkan
	scripts/test.sh

# What takes hours: hostile inputs, night captures, long runs, kills, fuzzing. docs/measurements.md has what it found.
stress: vulkan
	scripts/stress.py

.PHONY: vulkan
vulkan:
	@scripts/install-vulkan.sh
