"""What a sensor adds to the feature: noise of several families, outliers, occlusions, lost and late frames."""
