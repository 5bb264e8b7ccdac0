# SPDX-License-Identifier: Apache-2.0
"""Triangles of marching cubes (Lorensen and Cline 1987), as PyMCubes cuts: its import takes 10 MB and 0.1 s."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt

_MOST_TRIANGLES = 5
"""Triangles in one cube."""
_EDGES = dict(zip("abcdefghijkl", (0, 1, 2, 3, 8, 9, 12, 13, 16, 18, 20, 22), strict=True))
"""Edges of a cube: 8 times their axis plus the bits of their lower end."""
_TRIANGLES = """
- aie bfi beafeb ejc ajcija ibfejc jbfjcbcab fdj eaijfd dibjid edjeadabd fcedcf faifdadca iceibcbdc abcbdc agk
giekig agkibf bgkbfgfeg gkacej gjcgkjkij kagibfcej bfjkbjkjckcg agkjfd igkiegjfd idjibdkag kbdkdekegjed cfdcefagk
gdcgidgkiifd gkacebcbdbei gkbgbccbd khb khbaie kfihfk keakhehfe khbcej ajcaijbkh fkhfikejc khfkfckcacfj bkhfdj
aiebkhjfd dkhdjkjik edjadeahdakh fcefdchbk khbaidadcdif hikhcihdceic khdkdaadc ahbgha ihbiehegh afiagfghf gheehf
ahbaghcej cghchicijbih cejagigfighf jcgjgffgh haghbafdj jfdiebehbegh ajiahjaghhdj djedehheg edcefdghahba
dcidifcgibihghi ghigiahdieicdci ghdcgd gcl aiegcl gclibf ebfeabgcl elgjle algailijl elgejlfib gjlgbjgabfjb lgcdjf
gcleaidjf dibdjiclg gcleajadjabd lfdlgfgef lfdgflgifgai igeidgibddlg lgaladdab kclack cieclilki kclkacibf
clkckfcfefkb ekaejkjlk killij bfikajkjljae bfjbjkkjl ckaclkdjf djfclelielki bjibdjackclk lkeleckbejedbde
aefaflalkdlf fdlfliilk bdebeidleaeklke lkbdlb gclkhb eaigclbkh kfikhflgc lgckhaheahfe lejlgekhb bkhaigilgijl
khiihflgelej hfahakfjagaljla khblgcfdj djfgclaiebkh gclkhjkjijhd ajeadjakdhdkgcl khblgdgfdgef gdlgfdgafifakhb
gedgdleidhdkikd lgaladkhahda hclhbcbac clhechehbebi iacichihflhc clhcheehf hbahajhjljae hbihillij jlajaelhaiafhfa
jlhfjh fdjhblbclbac ebiehbechlhcjfd jihjhdiahlhcach djedehclelhe balblhaeldlfefl fdlflihblbil aeihdl lhd ldh aiehld
hldbfi beabfedhl cejldh jaijcaldh ejcfibldh hldbfcbcacfj jhlfhj jhljfhiea hibhlilji habhjahljjea chlcehefh
icaihcifhlch chlehcebheib hlchcbbca kaghld giegkihld gkahldibf ldhgkfgfefkb agkcejhld hldgkckjckij agkbficejhld
kcgkjckbjfjbhld hjfhljgka lfhljfkigieg agkibliljlbh ljblbhjebkbgegb kaghlehefelc kickcgifclchfhc elcehleihbhiagk
hlchcbgkckbc lbkdbl bldbklaie fldfilikl afealfakldfl lbkldbjce aiccijbklbld cejldilikidf cafcfjakfdflklf bjfbkjklj
aiebkfkjfklj klilji eakekjjkl cklcfkceffbk klfkfblcfifacaf ceicillik klcakc lagldadba iegigdidbdgl ldfglfgfigia
ldflfggfe ejcagdadbdgl dbgdglbigcgjijg giagfiglfdflcej jcgjgfldgdfg gljgjbgbafbj egbebiglbfbjljb aglaliilj egljel
eflelcfblglabal glcifb ceicilagigli glc gdhcdg gdhgcdeai dgcdhgbfi gchhcdeabebf dejdhehge aijajhahghjd ibfejhehghjd
hgjhjdgajfjbabj jgcjfgfhg aiegcfgfhfcj chgcihcjibhi abjajebhjcjghgj gehefh aifafggfh ibhiheehg abhgah kdhkadacd
hkihichcdeci ibfkahadhacd fekfkbeckhkdcdk ejdaedadhahk dhkdkjjki ahkadhaedjdeibf dhkdkjbfkfjk kfhkcfkaccjf
fhcfcjhkcecikic achahkcjhbhijih kbhcje kaekehhef kifhkf ibhihekahaeh kbh gbkgcbcdb eaigckcbkcdb gcdgdigikidf
cdkckgdfkakefek kdbkedkgejde ijgigajdgkgbdbg ikdidfkgdjdeged akgjdf bjfkjbkcjkgc kfbkjfkgjcjgaie gcjgjkkji
eakekjgckcjk bkgbgffge bkgbgfaigifg geikgi akg acbbcd iecicbbcd fiafaddac fecdfc ejdedaadb dbijdi fiafadejajda fjd
jfbjbccba jfbjbciebecb acjiaj ecj baefbe bif aei -
"""
"""Three letters a triangle, for each choice of corners inside, from none to all."""

Triangles = npt.NDArray[np.int8]


@cache
def triangle_table() -> Triangles:
    """Triangles (256, 5, 3) of a cube whose corners are inside (bit 4x + 2y + z set) or outside, -1: no more."""
    table = np.full((256, _MOST_TRIANGLES, 3), -1, dtype=np.int8)
    for code, letters in enumerate(_TRIANGLES.split()):
        edges = [_EDGES[letter] for letter in letters.strip("-")]
        table[code, : len(edges) // 3] = np.reshape(edges, (-1, 3))
    return table
