"""Commands that write images and their truth, convert them, compare them with real ones, and score answers to them."""
