# What a newcomer needs; everything else is cargo.

.PHONY: demo test

# Trains on a small dark set of our own making and leaves demo/index.html.
demo: vulkan
	cargo run --release -- demo --out demo

# Every test, on whatever Vulkan device is best; a software device will do.
test: vulkan
	cargo test

.PHONY: vulkan
vulkan:
	@scripts/install-vulkan.sh
