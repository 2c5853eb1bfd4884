"""Closed surfaces laid out without a seam: the flat orbifold 2222 and the flat torus.

| module | holds |
| --- | --- |
| ``embedding`` | ``embed_orbifold``, ``embed_torus``: a raw mesh to an ``Embedding``; other orders of its cones, other isotopy classes |
| ``cones`` | extremities of a surface, and the four of them that make the least distorted domain |
| ``lifts`` | which lift of its vertex each corner belongs to; ``group``: the symmetry group |
| ``tutte``, ``newton``, ``stars``, ``sweeps``, ``collapses``, ``gauges``, ``multiresolution`` | the layout: Tutte on a handful of triangles, then descent while the rest is put back |
| ``certificate`` | whether a map to R²/Γ is a homeomorphism, exactly |
| ``alignment``, ``collection_alignment`` | likely isotopy classes of maps between surfaces, best first |
| ``cover`` | nearest lifts of points, and their places on the mesh |
| ``repair`` | maps of a surface's copies of vertices made exact, and their flips turned back |
| ``maps`` | periodic, even and equivariant maps in torch |
| ``fitting`` | the even periodic spline nearest to a surface |
"""  # noqa: E501
