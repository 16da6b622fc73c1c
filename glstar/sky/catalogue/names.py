"""Names of stars (proper names, Bayer and Flamsteed designations), and constellations with their lines.

All ends of the lines are within 10" of a star of the Bright Star Catalogue, 99 % of them within 2".
``assets/constellations.json`` names its source; `tests/scripts/make_constellations.py` wrote it.
"""

import json
import unicodedata
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from glstar.arrays import Float
from glstar.errors import CatalogueError
from glstar.system.resources import asset

# Greek letters by the first three (or two) letters of their names, as in the Bright Star Catalogue.
_GREEK = {
    unicodedata.name(chr(code)).split()[-1].title()[:3]: chr(code)
    for code in range(ord("\N{GREEK SMALL LETTER ALPHA}"), ord("\N{GREEK SMALL LETTER OMEGA}") + 1)
    if chr(code) != "\N{GREEK SMALL LETTER FINAL SIGMA}"
}
_SUPERSCRIPT = str.maketrans("123456789", "¹²³⁴⁵⁶⁷⁸⁹")

# Proper names approved by the IAU Working Group on Star Names (IAU Catalog of Star Names, CC BY 4.0): HR number (- for
# stars that are not in the Bright Star Catalogue), HIP number, designation (- if there is none), name.
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

_FILE = "constellations.json"


class ProperName(NamedTuple):
    """A star's proper name, catalogue numbers and designation."""

    hr: int | None
    hip: int
    designation: str
    name: str


def proper_names() -> tuple[ProperName, ...]:
    """Return the proper names of stars; the HR number is None for stars that are not in the Bright Star Catalogue.

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
    """Return a designation of the Bright Star Catalogue in its usual notation.

    `bsc_name`: the column Name of the catalogue: Flamsteed number, three letters of the Bayer letter's name, its index,
    and the constellation, as in ``"12Alp2CVn"``, ``"Alp Car"``, ``"61 Cyg"``.  Returns the Bayer designation, else the
    Flamsteed designation: ``"α² CVn"``, ``"α Car"``, ``"61 Cyg"``; ``""`` for a star without either.
    """
    bsc_name = bsc_name.strip()
    if not bsc_name:
        return ""
    # The four parts have 3, 3, 1 and 3 characters; only the first may be shorter, so the columns count from the end.
    flamsteed, letter, index, constellation = (
        part.strip() for part in (bsc_name[:-7], bsc_name[-7:-4], bsc_name[-4:-3], bsc_name[-3:])
    )
    bayer = f"{_GREEK[letter]}{index.translate(_SUPERSCRIPT)}" if letter else flamsteed
    return f"{bayer} {constellation}"


@dataclass(frozen=True, slots=True, eq=False)
class Constellation:
    """One constellation, or one half of Serpens."""

    abbreviation: str  # abbreviation of the IAU: ``"Ori"``
    name: str  # Latin name: ``"Orion"``
    label_rad: Float  # (2,) position of its label: right ascension and declination, J2000
    # Lines through n stars each, (n, 2): right ascension in [0, 2 pi) and declination, equinox and epoch J2000.
    lines_rad: tuple[Float, ...]

    def __post_init__(self) -> None:
        for array in (self.label_rad, *self.lines_rad):
            array.flags.writeable = False


def constellations() -> tuple[Constellation, ...]:
    """Return the constellations sorted by abbreviation: 89, because Serpens Caput and Serpens Cauda are separate.

    Raises CatalogueError if the file is missing from this installation, or damaged.
    """
    path = asset(_FILE)
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))["constellations"]
        return tuple(
            Constellation(
                abbreviation=str(entry["abbreviation"]),
                name=str(entry["name"]),
                label_rad=_radians(entry["label_deg"]).reshape(2),
                lines_rad=tuple(_radians(line).reshape(-1, 2) for line in entry["lines_deg"]),
            )
            for entry in entries
        )
    except OSError as error:
        raise CatalogueError(path, f"cannot be read ({error.strerror}); install glstar again") from error
    except (ValueError, KeyError, TypeError) as error:
        raise CatalogueError(path, "is damaged; install glstar again") from error


def _radians(degrees: object) -> Float:
    """Return angles of the file in radians."""
    return np.deg2rad(np.asarray(degrees, dtype=np.float64))
