#!/usr/bin/env python3
"""Keeps header, formats, infos and the messages of some topics of a PX4 log."""
import struct, sys
keep={b'vehicle_attitude',b'vehicle_local_position',b'vehicle_global_position',b'vehicle_gps_position'}
d=open(sys.argv[1],'rb').read(); out=bytearray(d[:16]); at=16; ids=set()
topics=set(a.encode() for a in sys.argv[3:]) or keep
while at+3<=len(d):
    n,k=struct.unpack_from('<HB',d,at); m=d[at:at+3+n]; b=m[3:]; at+=3+n
    if k==ord('A'):
        name=b[3:]; 
        if name in topics and b[0]==0: ids.add(struct.unpack_from('<H',b,1)[0]); out+=m
    elif k==ord('D'):
        if struct.unpack_from('<H',b)[0] in ids: out+=m
    elif k==ord('F'):
        if b.split(b':')[0] in topics: out+=m
    elif k==ord('B'): out+=m[:3+16]+bytes(24)
    elif k==ord('I') and (b'ver_' in b or b'sys_name' in b): out+=m
open(sys.argv[2],'wb').write(out)
