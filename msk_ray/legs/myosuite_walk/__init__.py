"""MyoSuite's walking task of 80 muscles, for training on many worlds with gradients."""
