import numpy as np
rng=np.random.default_rng(1)
def run(flick,T=300,seed=1,q=1e-7,read=1e-6,step=2e-7):
    rng=np.random.default_rng(seed)
    n=64; pitch=0.03/64; s=1e-3
    c=(np.arange(n)-31.5)*pitch
    from math import erf
    E=0.81*2*0.05**2/0.6**2/3
    sp=[]
    for x in (-90,-30,30,90):
        for y in (-70,0,70):
            u,v=x*0.036/300,y*0.036/300
            fx=np.array([0.5*(erf((a+pitch/2-u)/s/2**.5)-erf((a-pitch/2-u)/s/2**.5)) for a in c])
            fy=np.array([0.5*(erf((a+pitch/2-v)/s/2**.5)-erf((a-pitch/2-v)/s/2**.5)) for a in c])
            sp.append(np.outer(fy,fx))
    sp=np.array(sp)
    fr=[]
    for k in range(T):
        e=E*np.clip(1+flick*rng.standard_normal(12),.1,None)
        L=np.tensordot(e,sp,1)
        P=q*rng.poisson(L/q)+read*rng.standard_normal(L.shape)
        fr.append(np.round(P/step)*step)
    fr=np.array(fr)
    M=fr.mean(0)
    D=np.diff(fr,axis=0)/2**.5
    gy,gx=np.zeros_like(M),np.zeros_like(M)
    gy[1:-1]=M[2:]-M[:-2]; gx[:,1:-1]=M[:,2:]-M[:,:-2]
    out=[]
    for y0 in range(0,n,8):
        for x0 in range(0,n,8):
            sl=(slice(y0,y0+8),slice(x0,x0+8))
            m=M[sl].ravel(); d=D[(slice(None),)+sl].reshape(T-1,-1)
            each=np.sort((d**2).mean(0)); quiet=each[len(each)//4]
            B=[np.ones(64)]
            if m.max()-m.min()>3*quiet**.5: B+=[m,gx[sl].ravel(),gy[sl].ravel()]
            Q,_=np.linalg.qr(np.array(B).T)
            h=(Q**2).sum(1)
            r=d-(d@Q)@Q.T
            v=(r**2).mean(0)/(1-h)
            out+= [(a,b) for a,b,hh in zip(m,v,h) if 1-hh>.5]
    out=np.array(sorted(out)); 
    print('E',E,'peak',M.max(),len(out))
    # levels
    N=len(out); dk,br=out[N//20,0],out[-1,0]
    cuts=sorted([0,N]+[k*N//12 for k in range(1,12)]+[int(np.searchsorted(out[:,0],dk+(br-dk)*(k/12)**2)) for k in range(1,12)])
    kept=[0]
    for cc in cuts:
        if cc-kept[-1]>=8 and (N-cc>=8 or cc==N): kept.append(cc)
    L=[]
    for a,b in zip(kept,kept[1:]):
        p=out[a:b]; md=np.sort(p[:,1])[len(p)//2]; p=p[p[:,1]<=4*md]
        L.append((p[:,0].mean(),p[:,1].mean(),(3/((T-1)*len(p)))**.5))
    L=np.array(L); line=np.array([L[0,1],0.])
    for _ in range(20):
        pred=np.maximum(line[0]+line[1]*L[:,0],.25*L[:,1]); w=(pred*L[:,2])**-2
        A=np.array([np.ones(len(L)),L[:,0]]).T
        C=np.linalg.inv(A.T@(w[:,None]*A)); line=C@(A.T@(w*L[:,1]))
    print(flick,seed,'gain',line[1]/q,'+-',C[1,1]**.5/line[1],'read',(line[0]-step**2/12)**.5/read, 'misfit',np.sqrt((np.maximum(np.abs(L[:,1]/(line[0]+line[1]*L[:,0])-1)-3*L[:,2],0)**2).mean()))
    return L
for f in (0,.1,.3):
    for sd in (1,2): run(f,seed=sd)
