import numpy as np
UNK=.03;MAXS=.25;STEADY=5.;MEM=60.;LEAST=1e-4
def sim(sigma,gap=.02,phase=0.,late=0.,seed=0,T=60,mode='fwd',amp=.037*1.414,w=.785,rate=10.):
    r=np.random.default_rng(seed); n=int((T+4)/gap); tp=-2+phase+gap*np.arange(n)
    tr=lambda t: np.array([amp*np.sin(w*t),amp*np.sin(.8*w*t+1)])
    att=np.array([tr(t) for t in tp])+sigma*r.standard_normal((n,2)); st=tp+late
    pose=lambda t: np.array([np.interp(t,st,att[:,k]) for k in (0,1)])
    d=0.;info=0.;mr=np.zeros(2);me=np.zeros(2);sc=0.;seen=0.;hist={}
    dt=1/rate
    for f in range(int(T*rate)):
        t=f*dt; s=t+d; k=np.searchsorted(st,s,side='right'); a,b=att[k-1],att[k]
        if mode=='fwd': rt=(b-a)/gap
        elif mode=='sym': rt=(pose(s+.1)-pose(s-.1))/.2
        e=pose(s)-tr(t)+1e-4*r.standard_normal(2)
        seen+=dt; bl=min(dt/min(seen,STEADY),1.); mr+=(rt-mr)*bl; me+=(e-me)*bl
        R=rt-mr;O=e-me; sc+=(.5*O@O-sc)*bl; info*=np.exp(-dt/MEM)
        if seen<STEADY: continue
        v=max(sc,LEAST**2); info+=R@R/v; g=1/(UNK**-2+info)/v; d=np.clip(d-g*(R@O),-MAXS,MAXS)
        for T0 in (10,30,59):
            if abs(t-T0)<dt/2: hist[T0]=(round((d-late)*1e3,2),round(1e3*max((UNK**-2+info)**-.5,2.5e-4),2))
    return hist
for mode in ('fwd','sym'):
  for sigma in (0,1e-3,3e-3):
    for phase in (0,.01):
      for late in (0,.03):
        print(mode,'sigma',sigma,'phase',phase,'late',late,[sim(sigma,phase=phase,late=late,seed=s,mode=mode) for s in (0,1)])
