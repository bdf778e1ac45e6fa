"""How sure recovered textures are: a Gaussian Markov random field around them."""
