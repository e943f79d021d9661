"""Classes of other packages, for annotations alone.

At run time each is `Any`: importing this module imports none of these packages, which take longer
to import than most commands to run.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from astropy.coordinates import BaseCoordinateFrame, SkyCoord
    from astropy.io.fits import BinTableHDU, HDUList, Header, ImageHDU, PrimaryHDU
    from astropy.nddata import CCDData, NDData
    from astropy.table import Column, QTable, Table
    from astropy.units import Quantity, UnitBase
    from astropy.wcs import WCS
    from batoid import CompoundOptic
    from h5py import Dataset, File
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure, FigureBase
    from matplotlib.image import AxesImage
    from pandas import DataFrame
    from photutils.psf import GriddedPSFModel
    from scipy.sparse import csc_array
    from threadpoolctl import ThreadpoolController
    from torch import Tensor
    from torch.nn import Module
else:
    Artist = AxesImage = FigureBase = Any
    BaseCoordinateFrame = SkyCoord = BinTableHDU = HDUList = Header = ImageHDU = PrimaryHDU = Any
    CCDData = NDData = Column = QTable = Table = Quantity = UnitBase = WCS = Any
    Dataset = File = Axes = LineCollection = Figure = DataFrame = GriddedPSFModel = Any
    csc_array = ThreadpoolController = CompoundOptic = Module = Tensor = Any
