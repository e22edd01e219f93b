"""A drone's flight over heliostats: glints of its lamp in their mirrors, and the normals that follow."""
