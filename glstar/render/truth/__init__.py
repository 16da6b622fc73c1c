"""Labels of a frame: its line of ground truth, statistics and peaks of trails, masks, and viewing conditions."""
