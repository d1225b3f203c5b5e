"""Methods to compare with: each chooses distributions of training images without the hypergradient."""
