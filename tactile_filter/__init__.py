"""SE(3) geometry, fusion of Gaussians, and the Bayesian filter over surface contact poses."""
