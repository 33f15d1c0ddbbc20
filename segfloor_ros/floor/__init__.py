"""Floor segmentation: disparity, u/v-disparity, floor profile, mask, camera mount."""
